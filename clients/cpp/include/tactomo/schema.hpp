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
inline constexpr std::array<std::string_view, 8> touches_seen{
    "channels_skewed", "companion_disputed", "companion_missing", "electrode_fault",
    "invalid_voltage", "magnitude_missing", "saturated", "untaught"};

/// Whether Contact::pressure_kpa can be believed, and what its absence means.
enum class PressureRange { unknown, within, below, above };
inline constexpr std::array<std::string_view, 4> pressure_ranges{
    "unknown", "within", "below", "above"};

struct Contact;

struct ContactFields {
    /// The contact's identity, kept while the contact moves less than 25 mm from frame to frame and
    /// through gaps of up to 5 frames. Where two contacts merge, the contact nearer to the middle
    /// of both keeps its identity. An identity that ended is not used again in this session.
    std::int64_t id = 0;
    /// Centre, to the right of the skin's middle, seen from the pressed side.
    double x_mm = 0;
    /// Centre, upwards from the skin's middle.
    double y_mm = 0;
    /// Pressed area.
    double area_mm2 = 0;
    /// |Δσ|/σ₀, mean over the contact's area. Unit: ratio.
    std::optional<double> magnitude;
    /// Standard uncertainty of `magnitude`. Unit: ratio.
    std::optional<double> magnitude_sigma;
    /// Pressure, mean over the contact's area; nil when unknown: see `pressure_range`.
    std::optional<double> pressure_kpa;
    /// Standard uncertainty of `x_mm`; nil where unknown.
    std::optional<double> x_sigma_mm;
    /// Standard uncertainty of `y_mm`; nil where unknown.
    std::optional<double> y_sigma_mm;
    /// Standard uncertainty of `area_mm2`; nil where unknown.
    std::optional<double> area_sigma_mm2;
    /// Standard uncertainty of `pressure_kpa`, the calibration's included; nil unless `within`.
    std::optional<double> pressure_sigma_kpa;
    /// Force: pressure times area, or learnt from presses of known force (`taught`). A lower bound
    /// (95 %) where `above`. Known even where `below` or `unknown`, if the response has no onset
    /// and the highest pressure is bounded: a small hard and a large light press have the same
    /// force.
    std::optional<double> force_n;
    /// Standard uncertainty of `force_n`; nil where `force_n` is nil or a lower bound, and where
    /// the uncertainty of the area is unknown.
    std::optional<double> force_sigma_n;
    /// `within`: the pressure is measured. `below`: the touch is too light for the magnitude
    /// channel; `pressure_kpa` is nil. `above`: the upper bound (95 %) exceeds the range of the
    /// response or calibration; `pressure_kpa` is a lower bound (95 %) and `max_kpa` nil.
    /// `unknown`: no magnitude channel, no response, or too uncertain. Noise near a limit does not
    /// change the range (hysteresis). Treat an absent field as `unknown`.
    PressureRange pressure_range = PressureRange::unknown;
    /// Highest pressure under the contact: above `pressure_kpa` where the object is soft. Nil where
    /// unknown, a lower bound (95 %) where `above`.
    std::optional<double> peak_kpa;
    /// Standard uncertainty of `peak_kpa`; nil unless `within`.
    std::optional<double> peak_sigma_kpa;
    /// Upper bound (95 %) of the highest pressure under the contact, also where `pressure_range` is
    /// `below` or `unknown`. Nil where nothing bounds the pressure: no magnitude channel, no
    /// uncertainty, or `above`.
    std::optional<double> max_kpa;
    /// Profile exponent γ: the pressure falls towards the edge as (1 − ρ²)^γ. 0 is flat, 0.5 is
    /// Hertzian; nil where unknown. What falls is taken for Hertzian, as under balls and fingers:
    /// of a pressure that falls more steeply, such as a cone's, the peak and its bounds are too
    /// low.
    std::optional<double> edge;
    /// Whether `x_mm`, `y_mm` and their uncertainties come from presses at known places (`tactomo
    /// teach`); so does `force_n` where the forces were known.
    bool taught = false;
    /// Centre on the sheet's surface, in the frame `frame`. `position_m`, `normal` and `frame` are
    /// nil where the sensor description has no `[mount]`.
    std::optional<std::array<double, 3>> position_m;
    /// Unit vector out of the sheet at `position_m`, in the frame `frame`: the object pushes
    /// against the normal.
    std::optional<std::array<double, 3>> normal;
    /// Name of the robot's link that carries the sheet.
    Text<63> frame;
};

struct FrameFields {
    /// A new random value at each start of the daemon. When `session` changes, contact identities
    /// and `sequence` begin anew.
    Text<64> session;
    /// Rises by one with each message of this kind in this session. A gap means missed messages.
    std::uint64_t sequence = 0;
    std::int64_t acquired_realtime_ns = 0;
    std::int64_t acquired_monotonic_ns = 0;
    /// Time from acquisition until the daemon had read the last byte of the dual scan.
    std::optional<std::int64_t> delay_ns;
    /// `device`: the acquisition time comes from the device's clock, so the age includes delays in
    /// buffers. `arrival`: the device has no clock or the daemon does not know the clock yet; the
    /// age excludes delays in buffers.
    Text<48> dated_by;
    /// Identity of the monotonic clock (on Linux the boot id, `/proc/sys/kernel/random/boot_id`);
    /// may be empty.
    Text<64> clock_id;
    /// Time of the dual scan on the device's clock, 0 to 2^53 − 1: the time of the magnitude scan,
    /// where there is one.
    std::optional<std::int64_t> device_us;
    /// Time of the magnitude scan minus time of the structure scan. Exact where one device took
    /// both; nil where a scan is missing or the clocks of two devices are not known yet.
    std::optional<double> skew_ms;
    /// Time from acquisition to publication: the age of the data when they left the daemon.
    std::optional<std::int64_t> age_ns;
    /// The method that made the frame: `quiet` (nothing pressed, nothing solved), `tikhonov`,
    /// `noser`, `fit` (a few contacts), `levelset` (a free form), `network` (a trained network
    /// alone), or another method by its name. Recordings of earlier versions may say `hybrid`:
    /// fitted outlines that a second network refined.
    Text<48> tier;
    /// Why this method, in words for people.
    Text<255> tier_reason;
    /// Reasons to distrust the frame; see Flags. Empty: none.
    std::vector<Text<48>> flags;
    /// Rms of the residual in units of the measured noise. About 1 is good. Above 2 the frame is
    /// flagged `misfit_high`, except where `network` has a `confidence` of 0.9 or more, or where a
    /// linear method explains half of the changes. Above 1.5 over both channels, `auto` shows the
    /// network's map. In a `quiet` frame: rms of the changes in units of the noise and of the
    /// description's `stability` (0.3 %); a frame is quiet below 1.24 (208 voltages).
    std::optional<double> misfit;
    /// Correlation with the truth that the network expects of its map, 0 to 1; nil where no network
    /// made the map.
    std::optional<double> confidence;
    Text<64> sensor;
    /// The dual scan's counter on the device (32 bits, wraps). All messages of one dual scan have
    /// the same counter.
    std::int64_t scan_counter = 0;
    /// The pressed areas. **An empty list means "nothing pressed"** only if the message is not
    /// stale and every touch is seen (see Stale, or nothing pressed?).
    std::vector<Contact> contacts;
    /// Force of all contacts together: 0 where nothing is pressed, nil where the force of a contact
    /// is nil, a lower bound where a contact is `above`. In these two cases, the force of a fitted
    /// companion of the whole sheet is told, where there is one.
    std::optional<double> force_n;
    /// Standard uncertainty of `force_n`. Smaller than the root sum of squares where contacts
    /// touch: their errors cancel. Nil where the uncertainty of a contact's force is nil and no
    /// companion tells it, and where nothing is pressed.
    std::optional<double> force_sigma_n;
    /// |Δσ|/σ₀ of the magnitude channel at each node; `map[iy][ix]`, row 0 at the bottom. Unit:
    /// ratio.
    Image map;
    /// Pressure at each node; nil when the sensor has no magnitude channel or the method gives no
    /// pressure. **0 only where nothing touches**; NaN under a contact whose pressure is unknown
    /// (`below` or `unknown`); a lower bound under a contact that is `above`.
    Image pressure_kpa;
    /// How surely each node is pressed, 0 to 1.
    Image structure;
    /// Position of the first and the last column. Columns are evenly spaced.
    std::array<double, 2> x_mm{};
    /// Position of the first and the last row.
    std::array<double, 2> y_mm{};
    /// Upper end of a sensible colour scale for `map`. Unit: ratio.
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
