// From the bytes of a `map` or `contacts` message to a Frame, by clients/STREAM.md.
//
// msgpack's parser runs over the bytes once and lays the values out on a tape; the fields are then
// read from the tape by name. Tape, buffer and frame keep their storage from message to message, so
// that nothing is allocated once they are large enough. Whatever the bytes, the outcome is a frame
// or the reason why it is none.
#pragma once

// Recent headers of msgpack want Boost, unless they are told to do without.
#if !defined(MSGPACK_NO_BOOST) && !defined(MSGPACK_USE_BOOST) && \
    !__has_include(<boost/predef/other/endian.h>)
#define MSGPACK_NO_BOOST
#endif
#include <msgpack.hpp>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "error.hpp"
#include "frame.hpp"

namespace tactomo {

inline constexpr int schema = 1;

enum class Kind {
    contacts,  ///< some hundred bytes a frame
    map,       ///< images, too: some 30 kB
};

/// What to subscribe to; the closing NUL belongs to it.
inline std::string topic(std::string_view sensor, Kind kind) {
    return std::string(sensor) + (kind == Kind::map ? "/map" : "/contacts") + '\0';
}

namespace detail {

/// Checks what STREAM.md allows for a sensor's name, and returns it.
inline std::string sensor_name(std::string name) {
    const auto is_alphanumeric = [](char c) {
        return (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
    };
    const bool fits = !name.empty() && name.size() <= 64 && is_alphanumeric(name.front()) &&
                      std::all_of(name.begin(), name.end(), [&](char c) {
                          return is_alphanumeric(c) || c == '_' || c == '.' || c == '-';
                      });
    if (fits) return name;
    throw MessageError("'" + name + "' is not a sensor name",
                       "use 1 to 64 letters, digits, '_', '-' or '.', starting with a letter or digit");
}

inline constexpr std::size_t max_message_bytes = 16 * 1024 * 1024;
inline constexpr std::uint32_t max_entries = 4096;
inline constexpr std::size_t max_depth = 16;
inline constexpr std::uint64_t max_array_values = 1024 * 1024;
inline constexpr std::size_t max_tokens = 256 * 1024;

struct Token {
    enum Type : std::uint8_t { nil, boolean, negative, positive, number, text, binary, list, map, other };

    Type type = nil;
    std::uint32_t size = 0;  // bytes of text and binary, entries of list and map
    std::uint32_t next = 0;  // the token after this one and all that is in it
    union {
        std::int64_t signed_value = 0;
        std::uint64_t unsigned_value;
        double real;
        const char* bytes;  // in the parser's buffer
    };

    bool is_text(std::string_view expected) const noexcept {
        return type == text && view() == expected;
    }
    std::string_view view() const noexcept { return {bytes, size}; }
};

inline bool is_utf8(const char* text, std::size_t size) noexcept {
    const auto* at = reinterpret_cast<const unsigned char*>(text);
    const auto* const end = at + size;
    while (at != end) {
        const unsigned char first = *at++;
        if (first < 0x80) continue;
        const int more = first >= 0xF0 ? 3 : first >= 0xE0 ? 2 : 1;
        if (first < 0xC2 || first > 0xF4 || end - at < more) return false;
        // Overlong forms, surrogates, and what is beyond U+10FFFF.
        const unsigned char low = first == 0xE0 ? 0xA0 : first == 0xF0 ? 0x90 : 0x80;
        const unsigned char high = first == 0xED ? 0x9F : first == 0xF4 ? 0x8F : 0xBF;
        if (*at < low || *at > high) return false;
        for (int i = 1; i < more; ++i) {
            if ((at[i] & 0xC0) != 0x80) return false;
        }
        at += more;
    }
    return true;
}

/// The values of one message in the order in which they stand there, as msgpack's parser visits them.
class Tape : public msgpack::null_visitor {
public:
    const Token& operator[](std::size_t index) const noexcept { return tokens_[index]; }
    void reserve(std::size_t tokens) { tokens_.reserve(tokens); }

    // From here on: what the parser calls. False ends the parsing.
    void init() noexcept {
        tokens_.clear();
        depth_ = 0;
        expects_key_ = false;
    }
    bool visit_nil() { return put({}); }
    bool visit_boolean(bool value) {
        Token made = token(Token::boolean);
        made.unsigned_value = value ? 1 : 0;
        return put(made);
    }
    bool visit_positive_integer(std::uint64_t value) {
        Token made = token(Token::positive);
        made.unsigned_value = value;
        return put(made);
    }
    bool visit_negative_integer(std::int64_t value) {
        // The signed encodings come here whatever their sign.
        if (value >= 0) return visit_positive_integer(static_cast<std::uint64_t>(value));
        Token made = token(Token::negative);
        made.signed_value = value;
        return put(made);
    }
    bool visit_float32(float value) { return visit_float64(static_cast<double>(value)); }
    bool visit_float64(double value) {
        Token made = token(Token::number);
        made.real = value;
        return put(made);
    }
    bool visit_str(const char* bytes, std::uint32_t size) {
        expects_key_ = false;
        return is_utf8(bytes, size) && put(bytes_token(Token::text, bytes, size));
    }
    bool visit_bin(const char* bytes, std::uint32_t size) {
        return put(bytes_token(Token::binary, bytes, size));
    }
    bool visit_ext(const char*, std::uint32_t) { return put(token(Token::other)); }
    bool start_array(std::uint32_t entries) { return open(Token::list, entries); }
    bool start_map(std::uint32_t entries) { return open(Token::map, entries); }
    bool end_array() noexcept { return close(); }
    bool end_map() noexcept { return close(); }
    bool start_map_key() noexcept { return expects_key_ = true; }

private:
    static Token token(Token::Type type) noexcept {
        Token made;
        made.type = type;
        return made;
    }
    static Token bytes_token(Token::Type type, const char* bytes, std::uint32_t size) noexcept {
        Token made = token(type);
        made.size = size;
        made.bytes = bytes;
        return made;
    }
    bool put(Token made) {
        if (expects_key_ || tokens_.size() >= max_tokens) return false;
        made.next = static_cast<std::uint32_t>(tokens_.size() + 1);
        tokens_.push_back(made);
        return true;
    }
    bool open(Token::Type type, std::uint32_t entries) {
        if (entries > max_entries || depth_ == max_depth) return false;
        open_[depth_++] = tokens_.size();
        Token made = token(type);
        made.size = entries;
        return put(made);
    }
    bool close() noexcept {
        tokens_[open_[--depth_]].next = static_cast<std::uint32_t>(tokens_.size());
        return true;
    }

    std::vector<Token> tokens_;
    std::array<std::size_t, max_depth> open_{};
    std::size_t depth_ = 0;
    bool expects_key_ = false;
};

/// msgpack's parser would tell this that it hands out a buffer; ours never gives one away.
struct KeepBuffer {
    void operator()(char*) const noexcept {}
};
inline KeepBuffer keep_buffer;

class Parser : public msgpack::parser<Parser, KeepBuffer> {
public:
    Parser() : msgpack::parser<Parser, KeepBuffer>(keep_buffer) {}

    /// The body's values, or nullptr where it is not one whole MessagePack value within the limits.
    const Tape* parse(std::string_view body) {
        skip_nonparsed_buffer(nonparsed_size());
        reset();
        reserve_buffer(body.size());
        std::memcpy(buffer(), body.data(), body.size());
        buffer_consumed(body.size());
        return next() && nonparsed_size() == 0 ? &tape_ : nullptr;
    }

    Tape& visitor() noexcept { return tape_; }
    bool referenced() const noexcept { return false; }
    void set_referenced(bool) noexcept {}

private:
    Tape tape_;
};

/// Reads a map's fields by name. The first one that is wrong is noted, and reading goes on.
class Fields {
public:
    /// `problem` gets the name of the first field that is wrong.
    Fields(const Tape& tape, std::size_t index, std::string_view& problem) noexcept
        : tape_(tape), index_(index), next_(index + 1), problem_(problem) {
        if (tape_[index].type != Token::map) fail("not a map");
    }

    void read(std::string_view name, std::int64_t& into, Allow) noexcept {
        into = integer(name, Allow::nothing).value_or(0);
    }
    void read(std::string_view name, std::uint64_t& into, Allow) noexcept { into = counter(name); }
    void read(std::string_view name, double& into, Allow) noexcept {
        into = number(name, Allow::nothing).value_or(0);
    }
    void read(std::string_view name, std::optional<std::int64_t>& into, Allow allow) noexcept {
        into = integer(name, allow);
    }
    void read(std::string_view name, std::optional<double>& into, Allow allow) noexcept {
        into = number(name, allow);
    }
    void read(std::string_view name, bool& into, Allow) noexcept { into = boolean(name); }
    template <std::size_t N>
    void read(std::string_view name, Text<N>& into, Allow allow) noexcept {
        into = text(name, allow);
    }
    void read(std::string_view name, PressureRange& into, Allow allow) noexcept {
        const auto* const found =
            std::find(pressure_ranges.begin(), pressure_ranges.end(), text(name, allow));
        into = found == pressure_ranges.end()
                   ? PressureRange::unknown
                   : static_cast<PressureRange>(found - pressure_ranges.begin());
    }
    void read(std::string_view name, std::array<double, 2>& into, Allow) noexcept {
        const Token* const token = value(name, Allow::nothing);
        if (token != nullptr) into = numbers<2>(name, *token);
    }
    void read(std::string_view name, std::optional<std::array<double, 3>>& into,
              Allow allow) noexcept {
        into.reset();
        const Token* const token = value(name, allow);
        if (token != nullptr) into = numbers<3>(name, *token);
    }
    void read(std::string_view name, Image& into, Allow) { image(name, into); }
    void read(std::string_view name, std::vector<Text<48>>& into, Allow) {
        into.clear();
        list(name, [&](std::size_t at) {
            if (tape_[at].type != Token::text) return fail(name);
            into.emplace_back() = tape_[at].view();
        });
    }
    void read(std::string_view name, std::vector<Contact>& into, Allow) {
        into.clear();
        list(name, [&](std::size_t at) {
            Fields entry(tape_, at, problem_);
            each_field_of_contact(into.emplace_back(),
                                  [&](std::string_view inside, auto& value, Allow allow) {
                                      entry.read(inside, value, allow);
                                  });
        });
    }
    std::optional<std::int64_t> integer(std::string_view name, Allow allow) noexcept {
        const Token* const token = value(name, allow);
        if (token == nullptr) return {};
        if (token->type == Token::negative) return token->signed_value;
        constexpr auto top = static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max());
        if (token->type == Token::positive && token->unsigned_value <= top) {
            return static_cast<std::int64_t>(token->unsigned_value);
        }
        fail(name);
        return {};
    }
    std::uint64_t counter(std::string_view name) noexcept {
        const Token* const token = value(name, Token::positive);
        return token == nullptr ? 0 : token->unsigned_value;
    }
    std::optional<double> number(std::string_view name, Allow allow) noexcept {
        const Token* const token = value(name, allow);
        if (token == nullptr) return {};
        const std::optional<double> read = as_number(*token);
        if (!read) fail(name);
        return read;
    }
    /// False where it is absent.
    bool boolean(std::string_view name) noexcept {
        const Token* const token = value(name, Allow::absence);
        if (token == nullptr) return false;
        if (token->type != Token::boolean) fail(name);
        return token->type == Token::boolean && token->unsigned_value != 0;
    }
    std::string_view text(std::string_view name, Allow allow = Allow::nothing) noexcept {
        const Token* const token = value(name, allow);
        if (token == nullptr) return {};
        if (token->type != Token::text) fail(name);
        return token->type == Token::text ? token->view() : std::string_view();
    }
    /// Calls `each` with the index of every entry of a list.
    template <typename Each>
    void list(std::string_view name, const Each& each) {
        const Token* const token = value(name, Token::list);
        if (token == nullptr) return;
        std::size_t at = index_of(token) + 1;
        for (std::uint32_t entry = 0; entry < token->size; ++entry, at = tape_[at].next) each(at);
    }
    /// A list of so many numbers.
    template <std::size_t N>
    std::array<double, N> numbers(std::string_view name, const Token& token) noexcept {
        std::array<double, N> values{};
        if (token.type != Token::list || token.size != N) {
            fail(name);
            return values;
        }
        const Token* entry = &token;
        for (double& number : values) {
            const std::optional<double> read = as_number(*++entry);
            if (!read) return fail(name), values;  // one that is a list has further tokens
            number = *read;
        }
        return values;
    }
    /// A two-dimensional array of float32; cleared where there is none.
    void image(std::string_view name, Image& into) {
        into.clear();
        const Token* const token = value(name, Allow::both);
        if (token == nullptr) return;
        Fields array(tape_, index_of(token), problem_);
        const Token* const shape = array.value("shape", Token::list);
        const Token* const data = array.value("data", Token::binary);
        if (array.text("dtype") != "<f4") fail(name);
        if (shape == nullptr || data == nullptr || shape->size != 2) return fail(name);
        const std::uint64_t rows = length(shape[1]);
        const std::uint64_t columns = length(shape[2]);
        if (rows > max_array_values || columns > max_array_values) return fail(name);
        const std::uint64_t values = rows * columns;
        if (values > max_array_values || data->size != values * sizeof(float)) return fail(name);
        copy_floats(*data, into.reshape(rows, columns));
    }

    void fail(std::string_view problem) noexcept {
        if (problem_.empty()) problem_ = problem;
    }

private:
    /// The field's value; nullptr where it is nil or absent, which is a failure unless allowed.
    const Token* value(std::string_view name, Allow allow) noexcept {
        const std::optional<std::size_t> found = find(name);
        const bool is_nil = found && tape_[*found].type == Token::nil;
        if (found && !is_nil) return &tape_[*found];
        const Allow needed = is_nil ? Allow::nil : Allow::absence;
        if ((static_cast<unsigned>(allow) & static_cast<unsigned>(needed)) == 0) fail(name);
        return nullptr;
    }
    /// The field's value, which has to be of this type; nullptr where it is not.
    const Token* value(std::string_view name, Token::Type type) noexcept {
        const Token* const token = value(name, Allow::nothing);
        if (token != nullptr && token->type == type) return token;
        fail(name);
        return nullptr;
    }
    /// Index of a field's value. Looks on from the field found last, for they mostly come in the order
    /// in which they are read.
    std::optional<std::size_t> find(std::string_view name) noexcept {
        if (tape_[index_].type != Token::map) return {};
        for (std::uint32_t entry = 0; entry < tape_[index_].size; ++entry) {
            if (next_ == tape_[index_].next) next_ = index_ + 1;
            const std::size_t key = next_;
            next_ = tape_[key + 1].next;
            if (tape_[key].view() == name) return key + 1;
        }
        return {};
    }
    std::size_t index_of(const Token* token) const noexcept {
        return static_cast<std::size_t>(token - &tape_[0]);
    }
    static std::optional<double> as_number(const Token& token) noexcept {
        if (token.type == Token::positive) return static_cast<double>(token.unsigned_value);
        if (token.type == Token::negative) return static_cast<double>(token.signed_value);
        if (token.type == Token::number && std::isfinite(token.real)) return token.real;
        return {};
    }
    static std::uint64_t length(const Token& token) noexcept {
        return token.type == Token::positive ? token.unsigned_value : max_array_values + 1;
    }
    /// Little-endian, and at any address, into floats of this computer's.
    static void copy_floats(const Token& data, float* into) noexcept {
        const auto* bytes = reinterpret_cast<const unsigned char*>(data.bytes);
        for (std::uint32_t at = 0; at < data.size; at += 4, ++into) {
            const std::uint32_t bits = std::uint32_t{bytes[at]} | std::uint32_t{bytes[at + 1]} << 8 |
                                       std::uint32_t{bytes[at + 2]} << 16 |
                                       std::uint32_t{bytes[at + 3]} << 24;
            std::memcpy(into, &bits, sizeof bits);
        }
    }

    const Tape& tape_;
    std::size_t index_;
    std::size_t next_;  // where to look for the next field's name
    std::string_view& problem_;
};

/// Identity of this computer's monotonic clock, empty where it has none.
inline std::string clock_id() {
    std::ifstream file("/proc/sys/kernel/random/boot_id");
    std::string id;
    file >> id;
    return id;
}

/// Decodes the messages of one topic.
class Decoder {
public:
    Decoder(std::string_view sensor, Kind kind, std::size_t max_contacts)
        : topic_(topic(sensor, kind)), kind_(kind), clock_id_(clock_id()) {
        constexpr std::size_t envelope_tokens = 256;
        constexpr std::size_t contact_tokens = 64;
        parser_.visitor().reserve(envelope_tokens + contact_tokens * max_contacts);
        parser_.reserve_buffer(64 * 1024);
    }

    /// Reads a message that came at `received` into `frame`. Empty if that went well; otherwise the
    /// field that is missing or wrong, or the rule that was broken, and the frame is of no use.
    std::string_view decode(std::string_view message, std::chrono::steady_clock::time_point received,
                            Frame& frame) {
        if (message.size() > max_message_bytes) return "larger than 16 MiB";
        if (message.substr(0, topic_.size()) != topic_) return "topic";
        const Tape* const tape = parser_.parse(message.substr(topic_.size()));
        if (tape == nullptr) return "not MessagePack, or beyond the limits";
        std::string_view problem;
        Fields fields(*tape, 0, problem);
        if (fields.counter("schema") != schema) return "schema";
        if (topic_.compare(0, topic_.find('/'), fields.text("sensor")) != 0) fields.fail("sensor");
        if (fields.text("kind") != (kind_ == Kind::map ? "map" : "contacts")) fields.fail("kind");
        const auto read = [&](std::string_view name, auto& value, Allow allow) {
            fields.read(name, value, allow);
        };
        each_field_of_frame(frame, read);
        if (kind_ == Kind::map) each_image_of_frame(frame, read);
        frame.received = received;
        frame.age_at_receipt = age(frame);
        return problem;
    }

private:
    /// Exact where publisher and subscriber read the same clock; otherwise the age at publication,
    /// which leaves out the time that the message was on its way.
    std::chrono::nanoseconds age(const Frame& frame) const noexcept {
        const std::int64_t acquired_ns = frame.acquired_monotonic_ns;
        const std::int64_t at_publication_ns = frame.age_ns.value_or(0);
        const bool same_clock = !clock_id_.empty() && frame.clock_id == clock_id_;
        // On Linux, which alone has such an identity, steady_clock is CLOCK_MONOTONIC.
        const std::int64_t received_ns =
            std::chrono::duration_cast<std::chrono::nanoseconds>(frame.received.time_since_epoch()).count();
        const bool is_past = acquired_ns <= received_ns;
        // Halved, so that no clock can be so wrong that ages overflow.
        constexpr std::int64_t limit_ns = std::numeric_limits<std::int64_t>::max() / 2;
        const std::int64_t oldest_ns = received_ns - limit_ns;
        const std::int64_t exact_ns =
            is_past ? received_ns - std::max(acquired_ns, oldest_ns) : std::int64_t{0};
        const std::int64_t ns = same_clock ? exact_ns : std::max<std::int64_t>(0, at_publication_ns);
        return std::chrono::nanoseconds(std::min(ns, limit_ns));
    }

    std::string topic_;
    Kind kind_;
    std::string clock_id_;
    Parser parser_;
};

}  // namespace detail
}  // namespace tactomo
