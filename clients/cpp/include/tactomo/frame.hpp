// What a subscriber receives: a Frame, one dual scan's outcome, and the Contacts in it.
//
// Plain values: copy them to keep them. What is not known (nil) is an empty optional or text, or an
// image that is false, never 0 or NaN: a skin whose magnitude channel is out still says where it is
// touched. Overwriting a frame reuses its storage.
#pragma once

#include <chrono>

#include "schema.hpp"

namespace tactomo {

/// What exceeds() answers. It is neither true nor false, so that no `if` takes cannot_tell for one
/// of the others.
enum class Answer { cannot_tell, no, yes };

/// One pressed area. It keeps its id for as long as it is followed from frame to frame.
struct Contact : ContactFields {
    /// Whether it presses with limit_kpa or more: yes by the best estimate of its highest pressure
    /// (the lower bound of 95 % of one that is above), no by the upper bound of 95 %. So noise moves the answer near the limit to and fro: stop at
    /// one, go on below a lower one.
    Answer exceeds(double limit_kpa) const noexcept {
        const std::optional<double>& estimate = peak_kpa ? peak_kpa : pressure_kpa;
        if (estimate && *estimate >= limit_kpa) return Answer::yes;
        return max_kpa && *max_kpa < limit_kpa ? Answer::no : Answer::cannot_tell;
    }
};

/// What the skin felt at one instant, and how far to trust it.
struct Frame : FrameFields {
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
