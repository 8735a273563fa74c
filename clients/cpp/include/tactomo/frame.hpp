// What a subscriber receives: a Frame, one dual scan's outcome, and the Contacts in it.
//
// Plain values: copy them to keep them. What is not known is an empty optional or text, or an image
// that is false, never 0 or NaN: a skin whose magnitude channel is out still says where it is
// touched. Overwriting a frame reuses its storage.
#pragma once

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string_view>
#include <vector>

namespace tactomo {

/// A string of at most N bytes, kept in place; what is longer is cut.
template <std::size_t N>
class Text {
public:
    Text& operator=(std::string_view text) noexcept {
        size_ = std::min(text.size(), N);
        // Never through the middle of a character.
        while (size_ < text.size() && size_ > 0 && (text[size_] & 0xC0) == 0x80) --size_;
        std::copy_n(text.data(), size_, bytes_.data());
        return *this;
    }

    std::string_view view() const noexcept { return {bytes_.data(), size_}; }
    operator std::string_view() const noexcept { return view(); }
    bool empty() const noexcept { return size_ == 0; }

    friend bool operator==(const Text& a, const Text& b) noexcept { return a.view() == b.view(); }
    friend bool operator!=(const Text& a, const Text& b) noexcept { return !(a == b); }
    friend bool operator==(const Text& a, std::string_view b) noexcept { return a.view() == b; }
    friend bool operator!=(const Text& a, std::string_view b) noexcept { return !(a == b); }

private:
    std::array<char, N> bytes_{};
    std::size_t size_ = 0;
};

/// Whether Contact::pressure_kpa can be believed, and what its absence means.
enum class PressureRange {
    unknown,  ///< no magnitude channel, no response, or not to be had
    within,   ///< within what was calibrated
    below,    ///< touched, but below what the magnitude channel answers to: no pressure
    above,    ///< beyond what was calibrated: the pressure is the range's top, a lower bound
};

/// What exceeds() answers. It is neither true nor false, so that no `if` takes cannot_tell for one
/// of the others.
enum class Answer { cannot_tell, no, yes };

/// One pressed area. It keeps its id for as long as it is followed from frame to frame.
struct Contact {
    std::int64_t id = 0;
    double x_mm = 0;  ///< centre, from the middle of the skin to the right, seen from outside
    double y_mm = 0;  ///< centre, from the middle of the skin upwards
    double area_mm2 = 0;
    std::optional<double> magnitude;  ///< |Δσ|/σ₀ inside it, a ratio
    std::optional<double> magnitude_sigma;
    std::optional<double> pressure_kpa;
    std::optional<double> pressure_sigma_kpa;
    std::optional<double> force_n;  ///< pressure times area
    std::optional<double> force_sigma_n;
    std::optional<double> x_sigma_mm;  ///< the sigmas are standard uncertainties
    std::optional<double> y_sigma_mm;
    std::optional<double> area_sigma_mm2;
    PressureRange pressure_range = PressureRange::unknown;
    std::optional<double> peak_kpa;  ///< highest pressure under it; pressure_kpa is a mean
    std::optional<double> peak_sigma_kpa;
    std::optional<double> max_kpa;  ///< upper bound of the highest, 95 %, in every pressure_range
    std::optional<double> edge;     ///< γ of its pressure (1 - ρ²)^γ: 0 flat, 0.5 Hertz
    bool taught = false;  ///< presses at known places say where it is; else the physics alone does

    /// Whether it presses with limit_kpa or more: yes by the best estimate of its highest pressure
    /// (the lower bound of 95 % of one that is above), no by the upper bound of 95 %. So noise moves the answer near the limit to and fro: stop at
    /// one, go on below a lower one.
    Answer exceeds(double limit_kpa) const noexcept {
        const std::optional<double>& estimate = peak_kpa ? peak_kpa : pressure_kpa;
        if (estimate && *estimate >= limit_kpa) return Answer::yes;
        return max_kpa && *max_kpa < limit_kpa ? Answer::no : Answer::cannot_tell;
    }
};

/// Values at the nodes of an even grid, row by row from the bottom; false where there are none.
class Image {
public:
    explicit operator bool() const noexcept { return known_; }
    std::size_t rows() const noexcept { return rows_; }
    std::size_t columns() const noexcept { return columns_; }
    /// rows() × columns() values, for Eigen::Map, cv::Mat and the like.
    const float* data() const noexcept { return values_.data(); }
    /// The value at node iy from the bottom and ix from the left; NaN: a node without a value.
    float operator()(std::size_t iy, std::size_t ix) const noexcept {
        return values_[iy * columns_ + ix];
    }

    void clear() noexcept {
        known_ = false;
        rows_ = columns_ = 0;
    }
    /// Make it rows × columns and return where the values go.
    float* reshape(std::size_t rows, std::size_t columns) {
        values_.resize(rows * columns);
        rows_ = rows;
        columns_ = columns;
        known_ = true;
        return values_.data();
    }

private:
    std::vector<float> values_;
    std::size_t rows_ = 0;
    std::size_t columns_ = 0;
    bool known_ = false;
};

/// Flags under which every touch is still seen: see STREAM.md. Of any other nobody knows.
inline constexpr std::array<std::string_view, 6> touches_seen{
    "magnitude_missing", "invalid_voltage", "electrode_fault",
    "saturated",         "channels_skewed", "untaught"};

/// What the skin felt at one instant, and how far to trust it. clients/STREAM.md has the fields.
struct Frame {
    Text<64> sensor;
    Text<64> session;  ///< changes when the daemon restarts: contact ids begin anew
    std::uint64_t sequence = 0;
    std::int64_t scan_counter = 0;
    std::int64_t acquired_realtime_ns = 0;   ///< when the scan was acquired, since 1970 (UTC)
    std::int64_t acquired_monotonic_ns = 0;  ///< the same instant on that computer's CLOCK_MONOTONIC
    std::optional<std::int64_t> device_us;   ///< the device's own clock
    std::optional<std::int64_t> delay_ns;    ///< from then until the daemon had read its last byte
    Text<16> dated_by;  ///< "device": what buffers held up is in its age; "arrival": it is not
    std::optional<double> skew_ms;           ///< the magnitude scan's time less the structure scan's
    Text<48> tier;                           ///< how much model it was given; empty: none
    Text<255> tier_reason;
    std::vector<Text<48>> flags;  ///< what to be wary of; empty when all is well
    std::optional<double> misfit;  ///< what the model left unexplained, in units of the noise
    std::optional<double> confidence;
    std::vector<Contact> contacts;
    std::optional<double> force_n;  ///< of all contacts together; at least that where one is above
    std::optional<double> force_sigma_n;
    Image map;  ///< |Δσ|/σ₀ of the magnitude channel; the images are only in Kind::map
    Image pressure_kpa;
    Image structure;               ///< how surely each node is pressed, 0 to 1
    std::array<double, 2> x_mm{};  ///< positions of the images' first and last column
    std::array<double, 2> y_mm{};  ///< positions of their first and last row

    std::chrono::nanoseconds age_at_receipt{0};
    std::chrono::steady_clock::time_point received{};
    std::chrono::nanoseconds stale_after{0};

    bool has_flag(std::string_view name) const noexcept {
        return std::find(flags.begin(), flags.end(), name) != flags.end();
    }

    /// Time since the scan was acquired. Exact on the daemon's computer; elsewhere without the time
    /// that the message was on its way.
    std::chrono::nanoseconds age() const noexcept {
        return age_at_receipt + (std::chrono::steady_clock::now() - received);
    }

    /// Whether it is too old to say anything: no contacts then means "not known".
    bool is_stale() const noexcept { return age() > stale_after; }

    /// Whether every touch would be among `contacts`: if there is none, nothing presses. False where
    /// the frame is stale, or a flag says that touches may be missing.
    bool is_known() const noexcept {
        return !is_stale() && std::all_of(flags.begin(), flags.end(), [](const Text<48>& flag) {
            return std::find(touches_seen.begin(), touches_seen.end(), flag.view()) !=
                   touches_seen.end();
        });
    }

    /// Whether any contact presses with limit_kpa or more: yes if one does; no only if none does, the
    /// frame is fresh and nothing flags it.
    Answer exceeds(double limit_kpa) const noexcept {
        Answer all = flags.empty() && !is_stale() ? Answer::no : Answer::cannot_tell;
        for (const Contact& contact : contacts) {
            const Answer one = contact.exceeds(limit_kpa);
            if (one == Answer::yes) return one;
            if (one == Answer::cannot_tell) all = one;
        }
        return all;
    }
};

}  // namespace tactomo
