// Subscribing to a sensor: ask for the latest frame from a control loop, or wait for each one.
#pragma once

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <zmq.hpp>

#include "error.hpp"
#include "frame.hpp"
#include "keys.hpp"
#include "message.hpp"

namespace tactomo {

struct Options {
    std::string address = "tcp://127.0.0.1:5560";  ///< the daemon's stream
    Kind kind = Kind::contacts;
    /// The age from which a frame is stale; 0 or more.
    std::chrono::nanoseconds stale_after = std::chrono::milliseconds(500);
    /// Queue frames while the caller is busy, for wait() to return each of them. Otherwise only the
    /// newest is kept, which is what a control loop wants.
    bool every_frame = false;
    /// How many contacts there is room for from the start, up to 4096. A frame with more makes room,
    /// once.
    std::size_t max_contacts = 64;
    Keys keys{};  ///< for a daemon beyond this computer: Keys::load("FOLDER")
};

/// An open subscription. Belongs to one thread, as ZeroMQ's sockets do; it has a thread of its own
/// that reads from the network.
class Subscription {
public:
    /// Returns at once, whether or not a daemon is there: frames come when it is, and again after it
    /// was restarted. Throws MessageError, ControlError ("bad_address"), KeysError, or
    /// std::invalid_argument where an option makes no sense.
    explicit Subscription(std::string sensor, Options options = {})
        : options_(sensible(std::move(options))),
          sensor_(detail::sensor_name(std::move(sensor))),
          decoder_(sensor_, options_.kind, options_.max_contacts),
          socket_(context_, zmq::socket_type::sub),
          handshakes_(socket_, !options_.keys.secret_key.empty()) {
        for (Frame& frame : frames_) {
            frame.contacts.reserve(options_.max_contacts);
            frame.flags.reserve(16);
        }
        connect();
    }

    Subscription(const Subscription&) = delete;
    Subscription& operator=(const Subscription&) = delete;

    /// The newest frame there is, without waiting; nullptr before the first one.
    ///
    /// The same one comes again where none is newer: look at Frame::is_stale(). It is valid until
    /// the next call of latest() or wait(). Never throws for what the wire brings.
    const Frame* latest() {
        // Where only the newest is kept, one look is enough, and bounds the time that this takes.
        for (std::size_t left = options_.every_frame ? queued : 1; left > 0 && take(); --left) read();
        if (is_stale()) knock_again();
        return newest_;
    }

    /// The next frame: waits for it, and returns nullptr where none comes in time or a signal
    /// interrupts. 0 or less, what is left of a time that is over, takes a frame that has come.
    /// Valid until the next call.
    const Frame* wait(std::chrono::milliseconds timeout) {
        const auto deadline = std::chrono::steady_clock::now() + detail::bounded(timeout);
        for (;;) {
            while (take()) {
                if (read()) return newest_;
            }
            const auto left = std::chrono::ceil<std::chrono::milliseconds>(
                deadline - std::chrono::steady_clock::now());
            if (left.count() <= 0 || !poll(std::min(left, knock_period))) return nullptr;
            if (is_stale()) knock_again();
        }
    }

    /// Whether the newest frame is too old to say anything, or there was none yet.
    bool is_stale() const noexcept { return newest_ == nullptr || newest_->is_stale(); }

    /// How many frames were published but never seen here, by gaps in `sequence`: also those that a
    /// newer one replaced while the caller was busy.
    std::uint64_t missed() const noexcept { return missed_; }
    /// How many messages were skipped because they broke the rules of STREAM.md.
    std::uint64_t malformed() const noexcept { return malformed_; }
    /// The field, or the rule, that the last of them broke; "schema" where the daemon is of another
    /// version.
    std::string_view malformed_by() const noexcept { return malformed_by_; }
    /// How often the daemon was found to have been restarted: contact ids began anew.
    std::uint64_t restarts() const noexcept { return restarts_; }
    /// Why nothing may come: looked at once a second while frames are stale.
    Door door() const noexcept { return door_; }
    const std::string& sensor() const noexcept { return sensor_; }

private:
    static constexpr std::chrono::milliseconds knock_period{1000};
    static constexpr std::size_t queued = 1000;  // what ZeroMQ keeps for a reader

    static Options sensible(Options options) {
        if (options.stale_after.count() < 0) {
            throw std::invalid_argument("stale_after is negative: give the age from which a frame "
                                        "is stale");
        }
        if (options.max_contacts > detail::max_entries) {
            throw std::invalid_argument("max_contacts is " + std::to_string(options.max_contacts) +
                                        ": a frame has at most 4096");
        }
        return options;
    }

    void connect() {
        socket_.set(zmq::sockopt::linger, 0);
        socket_.set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(detail::max_message_bytes));
        // A computer that lost power never closes its connections; heartbeats notice.
        socket_.set(zmq::sockopt::heartbeat_ivl, 1000);
        socket_.set(zmq::sockopt::heartbeat_timeout, 3000);
        socket_.set(zmq::sockopt::conflate, !options_.every_frame);
        detail::secure(socket_, options_.address, options_.keys);
        socket_.set(zmq::sockopt::subscribe, topic(sensor_, options_.kind));
        try {
            socket_.connect(options_.address);
        } catch (const zmq::error_t& error) {
            throw detail::bad_address(options_.address, error.what());
        }
    }

    /// Takes the next message out of the queue; false where there is none.
    bool take() {
        try {
            return socket_.recv(message_, zmq::recv_flags::dontwait).has_value();
        } catch (const zmq::error_t& error) {
            if (error.num() == EINTR) return false;
            throw;
        }
    }

    /// Reads the message that was taken; false where it is no frame.
    bool read() {
        const auto received = std::chrono::steady_clock::now();
        Frame& frame = newest_ == &frames_[0] ? frames_[1] : frames_[0];
        const std::string_view bytes(message_.data<char>(), message_.size());
        const std::string_view problem = decoder_.decode(bytes, received, frame);
        if (problem.empty()) {
            accept(frame);
        } else {
            ++malformed_;
            malformed_by_ = problem;
        }
        return problem.empty();
    }

    void accept(Frame& frame) {
        frame.stale_after = options_.stale_after;
        if (newest_ == nullptr) {
            frames_[1] = frame;  // gives the second one its storage, too
        } else if (newest_->session != frame.session) {
            ++restarts_;
        } else if (frame.sequence > newest_->sequence) {
            missed_ += frame.sequence - newest_->sequence - 1;
        }
        newest_ = &frame;
    }

    /// False where a signal interrupted.
    bool poll(std::chrono::milliseconds timeout) {
        zmq_pollitem_t item{socket_.handle(), 0, ZMQ_POLLIN, 0};
        return zmq_poll(&item, 1, static_cast<long>(timeout.count())) >= 0;
    }

    /// ZeroMQ never tries again by itself where a key was refused.
    void knock_again() {
        const auto now = std::chrono::steady_clock::now();
        if (now < knock_at_) return;
        knock_at_ = now + knock_period;
        door_ = handshakes_.look();
        if (door_ == Door::open) return;
        try {
            socket_.disconnect(options_.address);
        } catch (const zmq::error_t&) {  // it is gone altogether
        }
        try {
            socket_.connect(options_.address);
        } catch (const zmq::error_t&) {  // the next knock tries once more
        }
    }

    Options options_;
    std::string sensor_;
    detail::Decoder decoder_;
    zmq::context_t context_;
    zmq::socket_t socket_;
    detail::Handshakes handshakes_;
    zmq::message_t message_;
    std::array<Frame, 2> frames_;  // the newest, and where the next is read to
    const Frame* newest_ = nullptr;
    std::uint64_t missed_ = 0;
    std::uint64_t malformed_ = 0;
    std::string_view malformed_by_;
    std::uint64_t restarts_ = 0;
    Door door_ = Door::open;
    std::chrono::steady_clock::time_point knock_at_{};
};

}  // namespace tactomo
