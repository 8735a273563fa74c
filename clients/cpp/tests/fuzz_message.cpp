// Any bytes at all: a frame or the reason why it is none, the same from a decoder that has read others
// before; or a reply, or the error that says why it is none. `make fuzz` runs it.

#include <tactomo/client.hpp>

#include <cstdint>
#include <cstdlib>
#include <string_view>

namespace {

void check(bool holds) {
    if (!holds) std::abort();
}

// Of each image, every value is there.
void read_all(const tactomo::Image& image) {
    if (!image) return;
    for (std::size_t iy = 0; iy < image.rows(); ++iy) {
        for (std::size_t ix = 0; ix < image.columns(); ++ix) {
            volatile float value = image(iy, ix);
            (void)value;
        }
    }
}

void decode(tactomo::Kind kind, tactomo::detail::Decoder& used, std::string_view message) {
    const auto now = std::chrono::steady_clock::now();
    static tactomo::Frame frame;
    tactomo::Frame fresh_frame;
    tactomo::detail::Decoder fresh("left", kind, 0);
    const std::string problem(used.decode(message, now, frame));
    check(problem == fresh.decode(message, now, fresh_frame));
    if (!problem.empty()) return;
    check(frame.sensor == "left" && frame.contacts.size() == fresh_frame.contacts.size());
    check(frame.age_at_receipt.count() >= 0);
    for (const auto* image : {&frame.map, &frame.pressure_kpa, &frame.structure}) read_all(*image);
}

void reply(std::string_view bytes) {
    try {
        const tactomo::Reply read(tactomo::detail::unpack(zmq::message_t(bytes.data(), bytes.size())));
        read.get_or_nil<double>("scans");
        read.get_or_nil<std::vector<tactomo::detail::Members>>("ports");
    } catch (const tactomo::Error&) {
        return;
    }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    static tactomo::detail::Decoder maps("left", tactomo::Kind::map, 64);
    static tactomo::detail::Decoder contacts("left", tactomo::Kind::contacts, 64);
    const std::string_view message(reinterpret_cast<const char*>(data), size);
    decode(tactomo::Kind::map, maps, message);
    decode(tactomo::Kind::contacts, contacts, message);
    reply(message);
    return 0;
}
