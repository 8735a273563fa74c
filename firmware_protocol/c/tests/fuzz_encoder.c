/* Any fields, any room: a frame is within its bound and sound, or there is none; what the library
 * frames it also reads. */
#include "tactomo_protocol.h"
#include "unframe.h"

#include <stdlib.h>
#include <string.h>

enum { LONGEST_FRAME = TACTOMO_SCAN_BOUND(TACTOMO_MOST_SAMPLES, 4) };

/* As many bytes of the input as `size`, zeros after its end. */
static void draw(const uint8_t **data, size_t *n, void *into, size_t size)
{
    size_t taken = *n < size ? *n : size;
    memset(into, 0, size);
    if (taken > 0)
        memcpy(into, *data, taken);
    *data += taken;
    *n -= taken;
}

static void check(const uint8_t *frame, size_t size, size_t bound, uint8_t type)
{
    uint8_t payload[LONGEST_FRAME];
    tactomo_parser parser;
    tactomo_command command;
    bool found;
    if (size == 0)
        return;
    assert(size <= bound);
    assert(unframe(frame, size, payload) >= 2 && payload[0] == 1 && payload[1] == type);
    tactomo_parser_begin(&parser);
    assert(tactomo_parser_run(&parser, frame, size, &command, &found) == size);
    assert(found == (type == TACTOMO_COMMAND) && parser.counts.packets == 1);
}

static void scan(const uint8_t *data, size_t n, uint8_t *out, size_t room)
{
    uint8_t *samples = calloc(TACTOMO_MOST_SAMPLES, 4);
    tactomo_scan scan;
    size_t size, sample_bytes;
    draw(&data, &n, &scan, offsetof(tactomo_scan, samples));
    scan.sample_format = (uint8_t)(scan.sample_format % 5);
    scan.count = (uint16_t)(scan.count % 1030);
    scan.samples = samples;
    sample_bytes = scan.sample_format == TACTOMO_INT16 ? 2 : 4;
    draw(&data, &n, samples, (size_t)TACTOMO_MOST_SAMPLES * 4);
    size = tactomo_encode_scan(&scan, out, room);
    check(out, size, TACTOMO_SCAN_BOUND(scan.count * sample_bytes, 1u), TACTOMO_SCAN);
    if (size == 0 && room >= LONGEST_FRAME)
        assert(scan.channel > 1 || scan.count < 1 || scan.count > 1024 || sample_bytes == 0 ||
               scan.sample_format < 1 || scan.sample_format > 3 || scan.device_us >> 53);
    free(samples);
}

static void hello(const uint8_t *data, size_t n, uint8_t *out, size_t room)
{
    char texts[2][70];
    tactomo_hello hello;
    draw(&data, &n, &hello, offsetof(tactomo_hello, device_id));
    for (int i = 0; i < 2; i++) {
        draw(&data, &n, texts[i], sizeof texts[i]);
        texts[i][sizeof texts[i] - 1] = '\0';
    }
    hello.device_id = texts[0];
    hello.firmware = texts[1];
    check(out, tactomo_encode_hello(&hello, out, room), TACTOMO_HELLO_BOUND, TACTOMO_HELLO);
}

static void acknowledge(const uint8_t *data, size_t n, uint8_t *out, size_t room)
{
    uint8_t fields[3];
    draw(&data, &n, fields, sizeof fields);
    check(out, tactomo_encode_acknowledge(fields[0], fields[1], fields[2], out, room),
          TACTOMO_ACKNOWLEDGE_BOUND, TACTOMO_ACKNOWLEDGE);
}

static void companion(const uint8_t *data, size_t n, uint8_t *out, size_t room)
{
    tactomo_companion reading;
    draw(&data, &n, &reading, sizeof reading);
    check(out, tactomo_encode_companion(&reading, out, room), TACTOMO_COMPANION_BOUND,
          TACTOMO_COMPANION);
}

static void command(const uint8_t *data, size_t n, uint8_t *out, size_t room)
{
    uint8_t body[10];
    tactomo_frame frame;
    draw(&data, &n, body, sizeof body);
    tactomo_frame_begin(&frame, out, room, TACTOMO_COMMAND);
    tactomo_frame_bytes(&frame, body, sizeof body);
    check(out, tactomo_frame_end(&frame), TACTOMO_COMMAND_BOUND, TACTOMO_COMMAND);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    static void (*const each[])(const uint8_t *, size_t, uint8_t *, size_t) = {
        scan, hello, acknowledge, command, companion};
    uint8_t which = 0;
    uint16_t room = 0;
    uint8_t *out;
    draw(&data, &n, &which, 1);
    draw(&data, &n, &room, 2);
    if (which & 128)
        room = LONGEST_FRAME;
    out = malloc(room > 0 ? room : 1u); /* so that a byte too many is seen */
    each[(which & 127) % 5](data, n, out, room);
    free(out);
    return 0;
}
