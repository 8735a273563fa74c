// The client as a program for the tests, which say in words what to do and read JSON lines.
//
//     probe decode SENSOR KIND             messages from standard input, each after its length (4
//                                          bytes, little-endian): a frame, or why there is none
//     probe watch SENSOR ADDRESS KIND [KEYS]       every frame, and the state of the subscription
//                                                  at every silence of 200 ms
//     probe loop SENSOR ADDRESS KIND TURNS         latest() at 1 kHz: what it took
//     probe control ADDRESS COMMAND [ARGUMENT] [KEYS]     an empty argument: none
//     probe statuses ADDRESS COUNT                 so many commands, and the name of each one's error
//     probe give OPTION VALUE ADDRESS              an option of this value, and one use of it

#include <tactomo/client.hpp>

#include <time.h>

#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

// Counts what is allocated by one thread, whichever library does it. A sanitizer has its own malloc.
#if defined(__SANITIZE_ADDRESS__)
#define PROBE_COUNTS 0
#elif defined(__has_feature)
#if __has_feature(address_sanitizer)
#define PROBE_COUNTS 0
#endif
#endif
#ifndef PROBE_COUNTS
#define PROBE_COUNTS 1
#endif

static thread_local std::uint64_t allocations = 0;

#if PROBE_COUNTS
extern "C" {
void* __libc_malloc(std::size_t);
void* __libc_calloc(std::size_t, std::size_t);
void* __libc_realloc(void*, std::size_t);
void* __libc_memalign(std::size_t, std::size_t);

void* malloc(std::size_t size) {
    ++allocations;
    return __libc_malloc(size);
}
void* calloc(std::size_t count, std::size_t size) {
    ++allocations;
    return __libc_calloc(count, size);
}
void* realloc(void* old, std::size_t size) {
    ++allocations;
    return __libc_realloc(old, size);
}
void* aligned_alloc(std::size_t alignment, std::size_t size) {
    ++allocations;
    return __libc_memalign(alignment, size);
}
}
#endif

namespace {

using Clock = std::chrono::steady_clock;

void print(std::string_view text) { std::fwrite(text.data(), 1, text.size(), stdout); }

void print_text(std::string_view text) {
    std::putchar('"');
    for (const char c : text) {
        const auto code = static_cast<unsigned char>(c);
        if (code < 0x20 || c == '"' || c == '\\') {
            std::printf("\\u%04x", code);
        } else {
            std::putchar(c);
        }
    }
    std::putchar('"');
}

void print_value(bool value) { print(value ? "true" : "false"); }
void print_value(double value) { std::printf("%.17g", value); }
void print_value(std::int64_t value) { std::printf("%" PRId64, value); }
template <typename Value>
void print_value(const std::optional<Value>& value) {
    value ? print_value(*value) : print("null");
}

template <typename Value>
void print_member(const char* name, const Value& value) {
    std::printf(", \"%s\": ", name);
    print_value(value);
}
void print_member(const char* name, std::string_view value) {
    std::printf(", \"%s\": ", name);
    print_text(value);
}

std::string_view name_of(tactomo::Answer answer) {
    switch (answer) {
        case tactomo::Answer::yes:
            return "yes";
        case tactomo::Answer::no:
            return "no";
        case tactomo::Answer::cannot_tell:
            break;
    }
    return "cannot tell";
}

void print_value(std::uint64_t value) { std::printf("%" PRIu64, value); }
template <std::size_t N>
void print_value(const tactomo::Text<N>& value) {
    print_text(value);
}
void print_value(tactomo::PressureRange value) {
    print_text(tactomo::pressure_ranges[static_cast<std::size_t>(value)]);
}
void print_value(const std::array<double, 2>& value) {
    std::printf("[%.17g, %.17g]", value[0], value[1]);
}

void print_value(const std::optional<std::array<double, 3>>& value) {
    if (!value) return print("null");
    std::printf("[%.17g, %.17g, %.17g]", (*value)[0], (*value)[1], (*value)[2]);
}

void print_value(const tactomo::Contact& contact);

/// A list, each entry by its own print_value.
template <typename Value>
void print_value(const std::vector<Value>& values) {
    const char* separator = "[";
    for (const Value& value : values) {
        print(std::exchange(separator, ", "));
        print_value(value);
    }
    print(values.empty() ? "[]" : "]");
}

// Shape and the bytes of the values, as hexadecimal digits.
void print_value(const tactomo::Image& image) {
    if (!image) return print("null");
    std::printf("{\"shape\": [%zu, %zu], \"hex\": \"", image.rows(), image.columns());
    const auto* bytes = reinterpret_cast<const unsigned char*>(image.data());
    for (std::size_t i = 0; i < image.rows() * image.columns() * sizeof(float); ++i) {
        std::printf("%02x", bytes[i]);
    }
    print("\"}");
}

constexpr auto print_field = [](const char* name, const auto& value, auto) {
    std::printf(", \"%s\": ", name);
    print_value(value);
};

void print_value(const tactomo::Contact& contact) {
    print("{\"exceeds_150\": ");
    print_text(name_of(contact.exceeds(150)));
    tactomo::detail::each_field_of_contact(contact, print_field);
    print("}");
}

void print_frame(const tactomo::Frame& frame) {
    print("{\"exceeds_150\": ");
    print_text(name_of(frame.exceeds(150)));
    print_member("is_known", frame.is_known());
    print_member("age_now_ns", std::int64_t{frame.age().count()});
    tactomo::detail::each_field_of_frame(frame, print_field);
    tactomo::detail::each_image_of_frame(frame, print_field);
    print("}");
}

void print_state(const tactomo::Subscription& skin) {
    constexpr const char* doors[] = {"open", "key_refused", "keys_needed", "wrong_server"};
    std::printf("\"stale\": %s, \"missed\": %" PRIu64 ", \"malformed\": %" PRIu64
                ", \"restarts\": %" PRIu64 ", \"door\": \"%s\"",
                skin.is_stale() ? "true" : "false", skin.missed(), skin.malformed(),
                skin.restarts(), doors[static_cast<int>(skin.door())]);
    print_member("malformed_by", skin.malformed_by());
}

tactomo::Kind kind_named(std::string_view name) {
    return name == "map" ? tactomo::Kind::map : tactomo::Kind::contacts;
}

int decode(const std::string& sensor, tactomo::Kind kind) {
    tactomo::detail::Decoder decoder(sensor, kind, 64);
    tactomo::Frame frame;
    unsigned char head[4];
    std::vector<char> message;
    while (std::fread(head, 1, 4, stdin) == 4) {
        message.resize(head[0] | std::size_t{head[1]} << 8 | std::size_t{head[2]} << 16 |
                       std::size_t{head[3]} << 24);
        if (std::fread(message.data(), 1, message.size(), stdin) != message.size()) return 1;
        // A copy of exactly this size, so that a sanitizer sees each byte that is read beyond it.
        const std::vector<char> exact(message.begin(), message.end());
        const std::string_view problem =
            decoder.decode({exact.data(), exact.size()}, Clock::now(), frame);
        if (problem.empty()) {
            print_frame(frame);
        } else {
            print("{\"problem\": ");
            print_text(problem);
            print("}");
        }
        print("\n");
    }
    return 0;
}

int watch(const std::string& sensor, tactomo::Options options) {
    options.every_frame = true;
    tactomo::Subscription skin(sensor, options);
    for (;;) {
        const tactomo::Frame* const frame = skin.wait(std::chrono::milliseconds(200));
        print("{");
        print_state(skin);
        print(", \"frame\": ");
        frame != nullptr ? print_frame(*frame) : print("null");
        print("}\n");
        std::fflush(stdout);
    }
}

int loop(const std::string& sensor, const tactomo::Options& options, long turns) {
    tactomo::Subscription skin(sensor, options);
    std::uint64_t before_first = 0;
    std::uint64_t after_first = 0;
    std::uint64_t turns_that_allocated = 0;
    std::uint64_t frames = 0;
    std::uint64_t last = 0;
    std::chrono::nanoseconds worst{0};
    auto wake = Clock::now();
    for (long turn = 0; turn < turns;) {
        const bool had_one = frames > 0;
        const std::uint64_t allocated = allocations;
        const auto begin = Clock::now();
        const tactomo::Frame* const frame = skin.latest();
        worst = std::max<std::chrono::nanoseconds>(worst, Clock::now() - begin);
        const std::uint64_t more = allocations - allocated;
        (had_one ? after_first : before_first) += more;
        turns_that_allocated += had_one && more > 0;
        if (frame != nullptr && frame->sequence != std::exchange(last, frame->sequence)) ++frames;
        turn += had_one;
        std::this_thread::sleep_until(wake += std::chrono::milliseconds(1));
    }
    print("{");
    print_state(skin);
    std::printf(", \"counts\": %s, \"frames\": %" PRIu64 ", \"before_first\": %" PRIu64
                ", \"after_first\": %" PRIu64 ", \"turns_that_allocated\": %" PRIu64
                ", \"worst_us\": %.1f}\n",
                PROBE_COUNTS ? "true" : "false", frames, before_first, after_first,
                turns_that_allocated, static_cast<double>(worst.count()) * 1e-3);
    return 0;
}

void print_status(const tactomo::Status& status) {
    print("{\"sensor\": ");
    print_text(status.sensor);
    print_member("session", std::string_view(status.session));
    print_member("version", std::string_view(status.version));
    print_member("state", std::string_view(status.state));
    print_member("uptime_s", status.uptime_s);
    print_member("tier", std::string_view(status.tier.value_or("")));
    print_member("frames_hz", status.frames_hz);
    std::printf(", \"ports\": %zu, \"url\": ", status.ports.size());
    print_text(status.ports.empty() ? "" : status.ports.front().url);
    print("}\n");
}

int control(tactomo::Control daemon, const std::string& command, const std::string& argument) {
    if (command == "status") {
        print_status(daemon.status());
    } else if (command == "tare") {
        std::printf("%d\n", daemon.tare());
    } else if (command == "record_start") {
        print_text(daemon.record_start(argument));
    } else if (command == "record_stop") {
        const tactomo::Recording recording = daemon.record_stop();
        print("{\"path\": ");
        print_text(recording.path);
        std::printf(", \"bytes\": %" PRIu64 "}", recording.bytes);
    } else if (command == "set_tier") {
        print_text(daemon.set_method(argument));
    } else if (command == "set_budget") {
        print_value(daemon.set_budget(
            argument.empty() ? std::nullopt : std::optional(std::atof(argument.c_str()))));
    } else if (command == "reload_calibration") {
        print_text(daemon.reload_calibration().value_or("none"));
    } else if (command == "press") {
        daemon.request("press", tactomo::Control::patience, std::pair("x_mm", 20.0),
                       std::pair("y_mm", -10.0), std::pair("id", "probe"));
        print("{}");
    } else {
        daemon.request(command);
        print("{}");
    }
    return 0;
}

int statuses(tactomo::Control daemon, long count) {
    for (long i = 0; i < count; ++i) {
        try {
            daemon.status();
            print("\"\"\n");
        } catch (const tactomo::Error& error) {
            print_text(error.name());
            print("\n");
        }
    }
    return 0;
}

// Times are in milliseconds, but for stale_after: nanoseconds.
int give(const std::string& option, long long value, tactomo::Options options) {
    const auto time = std::chrono::milliseconds(value);
    if (option == "connect_timeout") {
        std::printf("%d\n", tactomo::Control(options.address, {}, time).tare());
        return 0;
    }
    if (option == "timeout") {
        tactomo::Control(options.address).request("clear", time);
        return 0;
    }
    if (option == "stale_after") options.stale_after = std::chrono::nanoseconds(value);
    if (option == "max_contacts") options.max_contacts = static_cast<std::size_t>(value);
    tactomo::Subscription skin("left", options);
    const auto wait = option == "wait" ? time : std::chrono::milliseconds(0);
    std::puts(skin.wait(wait) == nullptr ? "no frame" : "a frame");
    return 0;
}

}  // namespace

int main(int count, char** words) {
    const std::vector<std::string> said(words + 1, words + count);
    const auto word = [&](std::size_t i) { return i < said.size() ? said[i] : std::string(); };
    try {
        tactomo::Options options;
        options.address = word(2);
        if (word(0) == "decode") return decode(word(1), kind_named(word(2)));
        options.kind = kind_named(word(3));
        if (word(0) == "watch") {
            if (!word(4).empty()) options.keys = tactomo::Keys::load(word(4));
            return watch(word(1), options);
        }
        if (word(0) == "loop") return loop(word(1), options, std::atol(word(4).c_str()));
        if (word(0) == "statuses") return statuses(tactomo::Control(word(1)), std::atol(word(2).c_str()));
        options.address = word(3);
        if (word(0) == "give") return give(word(1), std::atoll(word(2).c_str()), options);
        tactomo::Keys keys;
        if (!word(4).empty()) keys = tactomo::Keys::load(word(4));
        return control(tactomo::Control(word(1), keys), word(2), word(3));
    } catch (const tactomo::Error& error) {
        std::fprintf(stderr, "%s: %s\n", error.name().c_str(), error.what());
        return 1;
    } catch (const std::invalid_argument& error) {
        std::fprintf(stderr, "invalid_argument: %s\n", error.what());
        return 1;
    }
}
