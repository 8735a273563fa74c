/* Takes a frame apart as PROTOCOL.md says, with its own words: what fuzzers hold the library to. */
#ifndef TACTOMO_UNFRAME_H
#define TACTOMO_UNFRAME_H

#include <assert.h>
#include <stddef.h>
#include <stdint.h>

static inline size_t cobs_decode(const uint8_t *in, size_t n, uint8_t *out)
{
    size_t i = 0, o = 0;
    while (i < n) {
        size_t code = in[i];
        if (code == 0 || i + code > n)
            return 0;
        for (size_t j = 1; j < code; j++)
            out[o++] = in[i + j];
        i += code;
        if (code != 255 && i < n)
            out[o++] = 0;
    }
    return o;
}

static inline uint32_t checksum(const uint8_t *bytes, size_t n)
{
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < n; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return crc ^ 0xFFFFFFFFu;
}

/* The payload of one whole frame, without its checksum; asserts that the frame is sound. */
static inline size_t unframe(const uint8_t *frame, size_t n, uint8_t *payload)
{
    size_t size;
    assert(n >= 9 && frame[0] == 0 && frame[n - 1] == 0);
    for (size_t i = 1; i + 1 < n; i++)
        assert(frame[i] != 0);
    size = cobs_decode(frame + 1, n - 2, payload);
    assert(size >= 6);
    size -= 4;
    for (size_t i = 0; i < 4; i++)
        assert(payload[size + i] == (uint8_t)(checksum(payload, size) >> 8 * i));
    return size;
}

#endif
