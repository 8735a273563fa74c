// The fields of a message, by clients/python/tactomo_client/schema.py: written by `make schema`.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string_view>
#include <vector>

#include "values.hpp"

namespace tactomo {

/// Flags under which every touch is still seen: see STREAM.md. Of any other nobody knows.
inline constexpr std::array<std::string_view, 6> touches_seen{
    "channels_skewed", "electrode_fault", "invalid_voltage", "magnitude_missing", "saturated",
    "untaught"};

/// Whether Contact::pressure_kpa can be believed, and what its absence means.
enum class PressureRange { unknown, within, below, above };
inline constexpr std::array<std::string_view, 4> pressure_ranges{
    "unknown", "within", "below", "above"};

struct Contact;

struct ContactFields {
    /// The contact's identity: kept while it moves less than 25 mm from frame to frame, and through
    /// gaps of up to 5 frames. Where two contacts merge, the one nearer to the middle of both lives
    /// on. An identity that ended is not used again in this session.
    std::int64_t id = 0;
    /// Its centre, from the skin's middle to the right, seen from the pressed side.
    double x_mm = 0;
    /// Its centre, from the skin's middle upwards.
    double y_mm = 0;
    /// Its area.
    double area_mm2 = 0;
    /// |Δσ|/σ₀ inside it. Unit: ratio.
    std::optional<double> magnitude;
    /// Standard uncertainty of `magnitude`. Unit: ratio.
    std::optional<double> magnitude_sigma;
    /// Pressure on it, a mean over its area; nil when unknown: see `pressure_range`.
    std::optional<double> pressure_kpa;
    /// Standard uncertainty of `x_mm`; nil where there is none.
    std::optional<double> x_sigma_mm;
    /// Standard uncertainty of `y_mm`; likewise.
    std::optional<double> y_sigma_mm;
    /// Standard uncertainty of `area_mm2`; likewise.
    std::optional<double> area_sigma_mm2;
    /// Standard uncertainty of `pressure_kpa`: the magnitude's and, where the sensor was
    /// calibrated, the calibration's. Nil but `within`.
    std::optional<double> pressure_sigma_kpa;
    /// Pressure times area; or as `taught` by presses of known force. Also in `below` and `unknown`
    /// where the sheet answers from no pressure on and the highest is bounded: small and hard or
    /// large and light, the force is known. A lower bound of 95 % where it is `above`.
    std::optional<double> force_n;
    /// Standard uncertainty of `force_n`; nil where that is nil or a lower bound, and where the
    /// area's is not known; or as `taught`.
    std::optional<double> force_sigma_n;
    /// `within`: measured. `below`: touched, but too lightly for the magnitude channel to answer;
    /// the pressure is unknown, and `pressure_kpa` nil. `above`: may be beyond what the sensor
    /// answers to or was calibrated to (the upper bound of 95 % is); `pressure_kpa` is a lower
    /// bound of 95 %, at most that range's top, and `max_kpa` nil. `unknown`: no magnitude channel,
    /// no response, or too uncertain to tell. Noise alone does not change it: near a border a
    /// contact stays in the range it was in. Take an absent one for `unknown`.
    PressureRange pressure_range = PressureRange::unknown;
    /// Highest pressure under it: above `pressure_kpa` where it is soft. Nil where unknown, a lower
    /// bound of 95 % where it is `above`.
    std::optional<double> peak_kpa;
    /// Standard uncertainty of `peak_kpa`; nil but `within`.
    std::optional<double> peak_sigma_kpa;
    /// Upper bound of its highest pressure, 95 %, also where `pressure_range` is `below` or
    /// `unknown`: what a light touch cannot exceed. Nil where nothing bounds it: no magnitude
    /// channel, no uncertainty, or `above`.
    std::optional<double> max_kpa;
    /// How the pressure falls to the edge, γ of (1 − ρ²)^γ: 0 flat, 0.5 as Hertz has it; nil where
    /// unknown.
    std::optional<double> edge;
    /// Whether presses at known places say where it is (`tactomo teach`): `x_mm`, `y_mm` and their
    /// uncertainties are then what was learnt, and `force_n` where forces were.
    bool taught = false;
    /// Where it is on the robot: its centre on the sheet's surface, in the frame `frame`. It, the
    /// normal and the frame are nil where the sensor description has no `[mount]`.
    std::optional<std::array<double, 3>> position_m;
    /// Unit vector out of the sheet there, in the frame `frame`: what presses pushes against it.
    std::optional<std::array<double, 3>> normal;
    /// Name of the robot's link that carries the sheet.
    Text<63> frame;
};

struct FrameFields {
    /// A new random value each time the daemon starts. When it changes, contact ids and `sequence`
    /// begin anew.
    Text<64> session;
    /// Rises by one with each message of this kind in this session. A gap means that some were
    /// missed.
    std::uint64_t sequence = 0;
    std::int64_t acquired_realtime_ns = 0;
    std::int64_t acquired_monotonic_ns = 0;
    /// From then until the daemon had read the dual scan's last byte.
    std::optional<std::int64_t> delay_ns;
    /// `device`: by the device's clock, so what buffers hold up is in the age. `arrival`: that
    /// clock is not known well enough yet, or is none; what buffers hold up goes unseen.
    Text<48> dated_by;
    /// Identity of that monotonic clock (on Linux the boot id, `/proc/sys/kernel/random/boot_id`);
    /// may be empty.
    Text<64> clock_id;
    /// The same dual scan's time on the device's own clock, 0 to 2^53 − 1: the magnitude scan's,
    /// where there is one.
    std::optional<std::int64_t> device_us;
    /// The magnitude scan's time less the structure scan's. Exact where one device took both; nil
    /// where one is missing, or two devices' clocks are not known well enough yet.
    std::optional<double> skew_ms;
    /// Time from `acquired` to publication: the age that the data already had when they left the
    /// daemon.
    std::optional<std::int64_t> age_ns;
    /// What made the frame: `quiet` (nothing pressed, nothing solved), `tikhonov`, `noser`, `fit`
    /// (a few contacts), `levelset` (a free form), `network` (a trained network alone), or another
    /// method by its name. Recordings of earlier versions may say `hybrid`: outlines that were
    /// fitted, then redrawn by a second network.
    Text<48> tier;
    /// Why, in words for people.
    Text<255> tier_reason;
    /// What to be wary of; see Flags. Empty: nothing.
    std::vector<Text<48>> flags;
    /// Rms of what the model left unexplained, in units of the measured noise. About 1 is good;
    /// above 2 the frame is flagged `misfit_high`, and above 1.5 over both channels where `auto`
    /// has a network stand in. (Not of a `network` that is sure, with a `confidence` of 0.9; of a
    /// linear tier, only above half of what the changes themselves are, too.) Of a `quiet` frame it
    /// is what told so: the changes in units of the noise and of the description's `stability` (0.3
    /// %), which skins reach by themselves; 1.24 (208 voltages) and more is not quiet.
    std::optional<double> misfit;
    /// Correlation of the map with the truth that a network expects, 0 to 1; nil where no network
    /// made the map.
    std::optional<double> confidence;
    Text<64> sensor;
    /// The dual scan's counter on the device (32 bits, wraps); the messages of one dual scan share
    /// it.
    std::int64_t scan_counter = 0;
    /// What is pressed now. **None means that nothing is pressed**, if the message is not stale and
    /// all touches are seen (see Stale, or nothing pressed?).
    std::vector<Contact> contacts;
    /// Force of all contacts together: 0 where nothing is pressed, nil where one contact's is, a
    /// lower bound where one is `above`.
    std::optional<double> force_n;
    /// Standard uncertainty of that: less than the contacts' own make where they touch, for the
    /// errors of one are then another's. Nil where one contact's is, and where nothing is pressed.
    std::optional<double> force_sigma_n;
    /// |Δσ|/σ₀ of the magnitude channel at each node; `map[iy][ix]`, row 0 at the bottom. Unit:
    /// ratio.
    Image map;
    /// The same as pressure; nil when the sensor has no magnitude channel or the method gives none.
    /// **0 only where nothing touches**; NaN where a contact does whose pressure is not known
    /// (`pressure_range` is `below` or `unknown`); a lower bound where it is `above`.
    Image pressure_kpa;
    /// How surely each node is pressed, 0 to 1.
    Image structure;
    /// Position of the first and the last column. The nodes between are evenly spaced.
    std::array<double, 2> x_mm{};
    /// Position of the first and the last row.
    std::array<double, 2> y_mm{};
    /// The top of a sensible colour scale for `map`. Unit: ratio.
    std::optional<double> magnitude_max;
};

namespace detail {

/// What may stand in place of a field's value.
enum class Allow : unsigned { nothing = 0, nil = 1, absence = 2, both = 3 };

/// Calls `each` with every field's name and value, and what may stand in its place.
template <typename Fields, typename Each>
void each_field_of_contact(Fields& fields, const Each& each) {
    each("id", fields.id, Allow::nothing);
    each("x_mm", fields.x_mm, Allow::nothing);
    each("y_mm", fields.y_mm, Allow::nothing);
    each("area_mm2", fields.area_mm2, Allow::nothing);
    each("magnitude", fields.magnitude, Allow::both);
    each("magnitude_sigma", fields.magnitude_sigma, Allow::both);
    each("pressure_kpa", fields.pressure_kpa, Allow::both);
    each("x_sigma_mm", fields.x_sigma_mm, Allow::both);
    each("y_sigma_mm", fields.y_sigma_mm, Allow::both);
    each("area_sigma_mm2", fields.area_sigma_mm2, Allow::both);
    each("pressure_sigma_kpa", fields.pressure_sigma_kpa, Allow::both);
    each("force_n", fields.force_n, Allow::both);
    each("force_sigma_n", fields.force_sigma_n, Allow::both);
    each("pressure_range", fields.pressure_range, Allow::absence);
    each("peak_kpa", fields.peak_kpa, Allow::both);
    each("peak_sigma_kpa", fields.peak_sigma_kpa, Allow::both);
    each("max_kpa", fields.max_kpa, Allow::both);
    each("edge", fields.edge, Allow::both);
    each("taught", fields.taught, Allow::absence);
    each("position_m", fields.position_m, Allow::both);
    each("normal", fields.normal, Allow::both);
    each("frame", fields.frame, Allow::both);
}

/// Calls `each` with every field's name and value, and what may stand in its place.
template <typename Fields, typename Each>
void each_field_of_frame(Fields& fields, const Each& each) {
    each("session", fields.session, Allow::nothing);
    each("sequence", fields.sequence, Allow::nothing);
    each("acquired_realtime_ns", fields.acquired_realtime_ns, Allow::nothing);
    each("acquired_monotonic_ns", fields.acquired_monotonic_ns, Allow::nothing);
    each("delay_ns", fields.delay_ns, Allow::both);
    each("dated_by", fields.dated_by, Allow::both);
    each("clock_id", fields.clock_id, Allow::absence);
    each("device_us", fields.device_us, Allow::nil);
    each("skew_ms", fields.skew_ms, Allow::both);
    each("age_ns", fields.age_ns, Allow::nil);
    each("tier", fields.tier, Allow::nil);
    each("tier_reason", fields.tier_reason, Allow::nil);
    each("flags", fields.flags, Allow::nothing);
    each("misfit", fields.misfit, Allow::nil);
    each("confidence", fields.confidence, Allow::both);
    each("sensor", fields.sensor, Allow::nothing);
    each("scan_counter", fields.scan_counter, Allow::nothing);
    each("contacts", fields.contacts, Allow::nothing);
    each("force_n", fields.force_n, Allow::both);
    each("force_sigma_n", fields.force_sigma_n, Allow::both);
}

/// Calls `each` with every field's name and value, and what may stand in its place.
template <typename Fields, typename Each>
void each_image_of_frame(Fields& fields, const Each& each) {
    each("map", fields.map, Allow::both);
    each("pressure_kpa", fields.pressure_kpa, Allow::both);
    each("structure", fields.structure, Allow::both);
    each("x_mm", fields.x_mm, Allow::nothing);
    each("y_mm", fields.y_mm, Allow::nothing);
    each("magnitude_max", fields.magnitude_max, Allow::both);
}

}  // namespace detail
}  // namespace tactomo
