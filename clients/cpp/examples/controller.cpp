// A controller with a loop of 1 kHz that goes by what a skin feels.
//
//     controller SENSOR [--stream ADDRESS] [--keys FOLDER] [--seconds N]
//
// It moves freely while nothing is pressed, slows down where it touches something or the skin warns,
// retreats from a hard contact until it is clearly lighter, and stops when no frame is fresh. What would be the
// robot is a line on standard output, each time that it changes. At the end, or at Ctrl-C, it tells
// how long latest() took and how late the loop woke up.

#include <tactomo/client.hpp>

#include <time.h>

#include <algorithm>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <string_view>
#include <vector>

namespace {

constexpr long period_ns = 1'000'000;
constexpr double hard_kpa = 150;
constexpr double calm_kpa = 140;  // lower, so that noise does not have it come and go

volatile std::sig_atomic_t stopping = 0;

struct Settings {
    std::string sensor;
    tactomo::Options options;
    double seconds = 1e9;
};

// Durations in bins of 100 ns up to 10 ms: filled without allocating, read at the end.
class Histogram {
public:
    void add(std::chrono::nanoseconds duration) {
        const auto bin = static_cast<std::size_t>(std::max<std::int64_t>(0, duration.count()) / 100);
        ++bins_[std::min(bin, bins_.size() - 1)];
        ++count_;
        worst_ = std::max(worst_, duration);
    }
    void print(const char* what) const {
        std::printf("%s: p50 %.1f us, p99 %.1f us, worst %.1f us\n", what, quantile_us(0.5),
                    quantile_us(0.99), static_cast<double>(worst_.count()) * 1e-3);
    }

private:
    double quantile_us(double share) const {
        const auto wanted = static_cast<std::uint64_t>(share * static_cast<double>(count_));
        std::uint64_t seen = 0;
        std::size_t bin = 0;
        while (bin < bins_.size() && (seen += bins_[bin]) <= wanted) ++bin;
        return static_cast<double>(bin) * 0.1;
    }

    std::vector<std::uint32_t> bins_ = std::vector<std::uint32_t>(100'000);
    std::uint64_t count_ = 0;
    std::chrono::nanoseconds worst_{0};
};

// What the robot should do, and why.
struct Decision {
    std::string_view action;
    std::string_view reason;
};

Decision decide(const tactomo::Frame* frame, tactomo::Door door, bool& retreats) {
    if (frame == nullptr || frame->is_stale()) {
        switch (door) {
            case tactomo::Door::open: break;
            case tactomo::Door::key_refused: return {"stop", "key refused: `tactomo keys allow`"};
            case tactomo::Door::keys_needed: return {"stop", "give keys: --keys FOLDER"};
            case tactomo::Door::wrong_server: return {"stop", "not the server of that public key"};
        }
    }
    if (frame == nullptr) return {"stop", "no frame yet: what does `tactomo status` say?"};
    if (frame->is_stale()) return {"stop", "stale"};
    const tactomo::Answer hard = frame->exceeds(retreats ? calm_kpa : hard_kpa);
    if (hard != tactomo::Answer::cannot_tell) retreats = hard == tactomo::Answer::yes;
    if (retreats) return {"retreat", "pressed hard"};
    if (!frame->flags.empty()) return {"slow", frame->flags.front()};
    if (hard == tactomo::Answer::cannot_tell) return {"slow", "cannot tell how hard"};
    // Touched, though perhaps too lightly for a pressure.
    if (!frame->contacts.empty()) return {"slow", "touched"};
    return {"move", "nothing pressed"};
}

void tell(const Decision& decision) {
    std::printf("%.*s: %.*s\n", static_cast<int>(decision.action.size()), decision.action.data(),
                static_cast<int>(decision.reason.size()), decision.reason.data());
    std::fflush(stdout);
}

// Sleeps until a point in time, so that delays do not add up; returns how late it woke.
std::chrono::nanoseconds sleep_until(timespec& wake) {
    wake.tv_nsec += period_ns;
    if (wake.tv_nsec >= 1'000'000'000) {
        wake.tv_nsec -= 1'000'000'000;
        ++wake.tv_sec;
    }
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &wake, nullptr);
    timespec now{};
    clock_gettime(CLOCK_MONOTONIC, &now);
    return std::chrono::seconds(now.tv_sec - wake.tv_sec) +
           std::chrono::nanoseconds(now.tv_nsec - wake.tv_nsec);
}

void run(const Settings& settings) {
    tactomo::Subscription skin(settings.sensor, settings.options);
    Histogram reading;
    Histogram lateness;
    std::string last;
    last.reserve(128);
    timespec wake{};
    clock_gettime(CLOCK_MONOTONIC, &wake);
    const auto turns = static_cast<std::uint64_t>(settings.seconds * 1e9 / period_ns);
    std::uint64_t turn = 0;
    bool retreats = false;
    for (; turn < turns && stopping == 0; ++turn) {
        lateness.add(sleep_until(wake));
        const auto before = std::chrono::steady_clock::now();
        const tactomo::Frame* const frame = skin.latest();
        reading.add(std::chrono::steady_clock::now() - before);

        const Decision decision = decide(frame, skin.door(), retreats);
        if (last != decision.reason) tell(decision);
        last = decision.reason;
    }
    std::printf("%llu turns, missed %llu frames, malformed %llu, restarts %llu\n",
                static_cast<unsigned long long>(turn),
                static_cast<unsigned long long>(skin.missed()),
                static_cast<unsigned long long>(skin.malformed()),
                static_cast<unsigned long long>(skin.restarts()));
    reading.print("latest()");
    lateness.print("woke up late by");
}

Settings read_arguments(int count, char** words) {
    Settings settings;
    for (int i = 1; i < count; ++i) {
        const std::string_view word = words[i];
        const bool is_last = i + 1 == count;
        if (word == "--stream" && !is_last) {
            settings.options.address = words[++i];
        } else if (word == "--keys" && !is_last) {
            settings.options.keys = tactomo::Keys::load(words[++i]);
        } else if (word == "--seconds" && !is_last) {
            char* rest = nullptr;
            settings.seconds = std::strtod(words[++i], &rest);
            if (*rest != '\0' || !(settings.seconds > 0 && settings.seconds <= 1e9)) {
                settings.sensor.clear();
                break;
            }
        } else if (settings.sensor.empty() && word.substr(0, 1) != "-") {
            settings.sensor = word;
        } else {
            settings.sensor.clear();
            break;
        }
    }
    return settings;
}

}  // namespace

int main(int count, char** words) {
    std::signal(SIGINT, [](int) { stopping = 1; });
    std::signal(SIGTERM, [](int) { stopping = 1; });
    try {
        const Settings settings = read_arguments(count, words);
        if (settings.sensor.empty()) {
            std::fputs("usage: controller SENSOR [--stream ADDRESS] [--keys FOLDER] [--seconds N]\n",
                       stderr);
            return 2;
        }
        run(settings);
    } catch (const tactomo::Error& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
    return 0;
}
