// Commands to a running daemon (or twin): one request, one reply, a clear error otherwise.
//
// Each waits for its reply and allocates: not for the thread of a control loop.
#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>
#include <zmq.hpp>

#include "error.hpp"
#include "keys.hpp"
#include "message.hpp"

namespace tactomo {

/// One of the daemon's ports. `problem` says why it is closed or of no use.
struct PortStatus {
    std::string url;
    bool connected = false;
    std::string state;  ///< "running" when all is well
    std::optional<std::string> problem;
};

/// How the daemon is. clients/STREAM.md has all the fields; the rest is in Control::request("status").
struct Status {
    std::string sensor;
    std::string session;
    std::string version;
    std::string state;  ///< waiting_for_port, waiting_for_data, taring, running or stale
    double uptime_s = 0;
    std::optional<std::string> tier;
    std::vector<std::string> flags;
    double frames_hz = 0;
    std::vector<PortStatus> ports;
};

/// What record_stop() left behind: the file, the last one of several.
struct Recording {
    std::string path;
    std::uint64_t bytes = 0;
};

namespace detail {

using Members = std::map<std::string, msgpack::object>;

/// A value of a reply; throws MessageError where it is missing or of another type.
template <typename Value>
Value member(const Members& members, const std::string& name) {
    const auto found = members.find(name);
    if (found == members.end()) throw MessageError("the reply has no '" + name + "'");
    try {
        return found->second.as<Value>();
    } catch (const msgpack::type_error&) {
        throw MessageError("'" + name + "' of the reply is of another type");
    }
}

template <typename Value>
std::optional<Value> member_or_nil(const Members& members, const std::string& name) {
    const auto found = members.find(name);
    if (found == members.end() || found->second.is_nil()) return std::nullopt;
    return member<Value>(members, name);
}

inline msgpack::object_handle unpack(const zmq::message_t& message) {
    // The rules for messages are the parser's; msgpack then takes what kept them.
    Parser parser;
    if (parser.parse({message.data<char>(), message.size()}) == nullptr) {
        throw MessageError("the reply is not MessagePack, or beyond the limits");
    }
    return msgpack::unpack(message.data<char>(), message.size());
}

inline Members members(const msgpack::object& object) {
    try {
        return object.as<Members>();
    } catch (const msgpack::type_error&) {
        throw MessageError("what should be a map is none");
    }
}

/// The result in a reply; throws ControlError where the command was refused.
inline msgpack::object result_in(const msgpack::object& reply) {
    const Members fields = members(reply);
    if (member<int>(fields, "schema") != schema) {
        throw MessageError("the reply is of another schema", "update this client");
    }
    if (member<bool>(fields, "ok")) return member<msgpack::object>(fields, "result");
    const Members error = members(member<msgpack::object>(fields, "error"));
    throw ControlError(member<std::string>(error, "name"), member<std::string>(error, "cause"),
                       member<std::string>(error, "next_step"));
}

inline void pack(msgpack::packer<msgpack::sbuffer>& packer, const std::optional<double>& value) {
    value ? packer.pack(*value) : packer.pack_nil();
}
template <typename Value>
void pack(msgpack::packer<msgpack::sbuffer>& packer, const Value& value) {
    packer.pack(value);
}

inline void throw_if_shut(Door door, const std::string& address) {
    switch (door) {
        case Door::open:
            return;
        case Door::key_refused:
            throw ControlError("key_refused", address + " does not let this client's key in",
                               "on the server's computer: tactomo keys allow NAME.key --may-command");
        case Door::keys_needed:
            throw ControlError("keys_needed", address + " hangs up on a client without keys",
                               "give the folder that holds them: Keys::load(\"FOLDER\")");
        case Door::wrong_server:
            throw ControlError("wrong_server", address + " is not the server of that public key",
                               "copy the server's NAME.key anew, or connect without keys");
    }
}

}  // namespace detail

/// A command's result. The values in it live as long as it does.
class Reply {
public:
    explicit Reply(msgpack::object_handle handle)
        : handle_(std::move(handle)), members_(detail::members(detail::result_in(handle_.get()))) {}

    /// A value of the result; throws MessageError where it is missing or of another type.
    template <typename Value>
    Value get(const std::string& name) const {
        return detail::member<Value>(members_, name);
    }
    /// Nothing where it is nil or missing.
    template <typename Value>
    std::optional<Value> get_or_nil(const std::string& name) const {
        return detail::member_or_nil<Value>(members_, name);
    }

private:
    msgpack::object_handle handle_;
    detail::Members members_;
};

/// Takes commands to one control socket. All throw ControlError (the command was refused, or nothing
/// answered: "no_answer"), MessageError (what answered does not speak this protocol) or KeysError, and
/// std::invalid_argument where a time is not above 0.
class Control {
public:
    /// `connect_timeout` is how long a command waits while nothing listens at the address, of the time
    /// that it has. A daemon that was started just now takes 2 to 3 s.
    explicit Control(std::string address = "tcp://127.0.0.1:5561", Keys keys = {},
                     std::chrono::milliseconds connect_timeout = std::chrono::seconds(5))
        : address_(std::move(address)),
          keys_(std::move(keys)),
          connect_timeout_(detail::above_zero("connect_timeout", connect_timeout)) {}

    Status status() {
        const Reply reply = request("status");
        Status read;
        read.sensor = reply.get<std::string>("sensor");
        read.session = reply.get<std::string>("session");
        read.version = reply.get<std::string>("version");
        read.state = reply.get<std::string>("state");
        read.uptime_s = reply.get<double>("uptime_s");
        read.tier = reply.get_or_nil<std::string>("tier");
        read.flags = reply.get<std::vector<std::string>>("flags");
        read.frames_hz = detail::member<double>(reply.get<detail::Members>("rates"), "frames_hz");
        for (const auto& port : reply.get<std::vector<detail::Members>>("ports")) {
            read.ports.push_back({detail::member<std::string>(port, "url"),
                                  detail::member<bool>(port, "connected"),
                                  detail::member<std::string>(port, "state"),
                                  detail::member_or_nil<std::string>(port, "problem")});
        }
        return read;
    }

    /// Takes the skin as it is now, with nothing on it, as the reference; returns of how many dual
    /// scans. Refused ("tare_refused") while the load changes; what lies
    /// still counts as nothing pressed from then on.
    int tare() { return request("tare", std::chrono::seconds(10)).get<int>("scans"); }

    /// Starts recording, and returns to which file, on the daemon's computer: of this name, below
    /// the folder of recordings that the daemon is configured with, or of names of its own.
    std::string record_start(const std::string& path = {}) {
        const Reply reply = path.empty() ? request("record_start")
                                         : request("record_start", patience, std::pair("path", path));
        return reply.get<std::string>("path");
    }

    Recording record_stop() {
        const Reply reply = request("record_stop");
        return {reply.get<std::string>("path"), reply.get<std::uint64_t>("bytes")};
    }

    /// What solves frames from now on: "auto", "fit", ...
    std::string set_method(const std::string& method) {
        return request("set_tier", patience, std::pair("tier", method)).get<std::string>("tier");
    }

    /// How long a frame may take from now on; nothing leaves it to the method.
    std::optional<double> set_budget(std::optional<double> budget_ms) {
        return request("set_budget", patience, std::pair("budget_ms", budget_ms))
            .get_or_nil<double>("budget_ms");
    }

    /// Has the sensor's pressure calibration read again, as after `tactomo calibrate`: a new one is in
    /// force at once. Returns when it was taken (ISO 8601, UTC); nothing where pressures go by the
    /// description. Refused ("calibration_refused") where it is damaged, or another sensor's or device's.
    std::optional<std::string> reload_calibration() {
        const Reply reply = request("reload_calibration", std::chrono::seconds(10));
        const auto found = reply.get_or_nil<detail::Members>("calibration");
        if (!found) return std::nullopt;
        return detail::member<std::string>(*found, "taken");
    }

    /// Any command, those of the twin, too: request("press", 2s, std::pair("x_mm", 10.0), ...).
    template <typename... Values>
    Reply request(std::string_view command, std::chrono::milliseconds timeout = patience,
                  const std::pair<const char*, Values>&... arguments) {
        timeout = detail::above_zero("timeout", timeout);
        msgpack::sbuffer bytes;
        msgpack::packer<msgpack::sbuffer> packer(bytes);
        packer.pack_map(3);
        packer.pack("schema").pack(schema);
        packer.pack("command").pack(command);
        packer.pack("arguments").pack_map(sizeof...(arguments));
        ((packer.pack(arguments.first), detail::pack(packer, arguments.second)), ...);
        return Reply(ask(zmq::message_t(bytes.data(), bytes.size()), timeout));
    }

    static constexpr std::chrono::milliseconds patience{2000};

private:
    // A socket per command: after an unanswered request a REQ socket cannot send another.
    msgpack::object_handle ask(zmq::message_t message, std::chrono::milliseconds timeout) {
        zmq::socket_t socket(context_, zmq::socket_type::req);
        socket.set(zmq::sockopt::linger, 0);
        socket.set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(detail::max_message_bytes));
        detail::secure(socket, address_, keys_);
        detail::Handshakes handshakes(socket, !keys_.secret_key.empty());
        try {
            socket.connect(address_);
        } catch (const zmq::error_t& error) {
            throw detail::bad_address(address_, error.what());
        }
        exchange(socket, message, handshakes, timeout);
        zmq::message_t reply;
        (void)socket.recv(reply);
        return detail::unpack(reply);
    }

    // Send, and wait until the reply is there. While the server lets nobody in, sending would block.
    void exchange(zmq::socket_t& socket, zmq::message_t& message, detail::Handshakes& handshakes,
                  std::chrono::milliseconds timeout) const {
        constexpr std::chrono::milliseconds look{100};
        bool is_sent = false;
        const auto begin = std::chrono::steady_clock::now();
        const auto replied_by = begin + timeout;
        auto connected_by = begin + connect_timeout_;
        for (;;) {
            is_sent = is_sent || socket.send(message, zmq::send_flags::dontwait).has_value();
            const auto left = std::chrono::ceil<std::chrono::milliseconds>(
                std::min(replied_by, connected_by) - std::chrono::steady_clock::now());
            zmq_pollitem_t item{socket.handle(), 0, ZMQ_POLLIN, 0};
            const auto wait = std::clamp(left, std::chrono::milliseconds(0), look);
            if (zmq_poll(&item, 1, static_cast<long>(wait.count())) > 0) return;
            detail::throw_if_shut(handshakes.look(), address_);
            const auto now = std::chrono::steady_clock::now();
            if (handshakes.is_connected()) connected_by = now + connect_timeout_;
            if (now < std::min(replied_by, connected_by)) continue;
            throw no_answer(std::chrono::duration_cast<std::chrono::milliseconds>(now - begin),
                            handshakes.is_connected());
        }
    }

    ControlError no_answer(std::chrono::milliseconds waited, bool is_connected) const {
        const std::string silence = "nothing answered at " + address_ + " within " +
                                    std::to_string(waited.count()) + " ms";
        if (is_connected) {
            return {"no_answer", silence + ", though something listens there",
                    "if it is the daemon's control socket, its log says what it is busy with"};
        }
        return {"no_answer", silence + ": nothing listens there",
                "start the daemon with `tactomo daemon` (a simulated skin: `tactomo twin`), or give "
                "the address of the one that runs"};
    }

    std::string address_;
    Keys keys_;
    std::chrono::milliseconds connect_timeout_;
    zmq::context_t context_;
};

}  // namespace tactomo
