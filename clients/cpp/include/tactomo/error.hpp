// What can go wrong between a client and the daemon, each with a name, a cause and a next step.
//
// Error
// ├── MessageError   a reply does not follow STREAM.md, or a sensor's name cannot be one
// ├── ControlError   a command was refused, or nothing answered it
// └── KeysError      keys cannot be used: a file is missing, or others may read it
//
// std::invalid_argument says that a time or a number which a caller gave makes no sense.
// None of these comes out of Subscription::latest(): what the wire brings is counted, not thrown.
#pragma once

#include <algorithm>
#include <chrono>
#include <stdexcept>
#include <string>
#include <utility>

namespace tactomo {

class Error : public std::runtime_error {
public:
    Error(std::string name, std::string cause, std::string next_step = {})
        : std::runtime_error(next_step.empty() ? cause : cause + "; " + next_step),
          name_(std::move(name)),
          cause_(std::move(cause)),
          next_step_(std::move(next_step)) {}

    /// A short stable identifier such as "no_answer", for programs.
    const std::string& name() const noexcept { return name_; }
    /// What went wrong, for people.
    const std::string& cause() const noexcept { return cause_; }
    /// What to do about it, for people; may be empty.
    const std::string& next_step() const noexcept { return next_step_; }

private:
    std::string name_;
    std::string cause_;
    std::string next_step_;
};

class MessageError : public Error {
public:
    explicit MessageError(std::string cause, std::string next_step = {})
        : Error("malformed_message", std::move(cause), std::move(next_step)) {}
};

class ControlError : public Error {
public:
    using Error::Error;
};

class KeysError : public Error {
public:
    explicit KeysError(std::string cause, std::string next_step = {})
        : Error("bad_keys", std::move(cause), std::move(next_step)) {}
};

namespace detail {

/// A wait, of a year at most: what is over is none, and a clock cannot be moved on for ever.
inline std::chrono::milliseconds bounded(std::chrono::milliseconds wait) {
    return std::clamp(wait, std::chrono::milliseconds(0),
                      std::chrono::milliseconds(std::chrono::hours(24 * 365)));
}

inline std::chrono::milliseconds above_zero(const char* name, std::chrono::milliseconds time) {
    if (time.count() > 0) return bounded(time);
    throw std::invalid_argument(std::string(name) + " is " + std::to_string(time.count()) +
                                " ms: give more than 0");
}

inline ControlError bad_address(const std::string& address, const char* reason) {
    return {"bad_address", "cannot connect to '" + address + "': " + reason,
            "an address looks like tcp://127.0.0.1:5560 (the stream), tcp://127.0.0.1:5561 (the "
            "control socket) or ipc:///run/tactomo/stream"};
}

}  // namespace detail
}  // namespace tactomo
