/* Any order of bytes, time, room and scans: whole frames or none, an acknowledgement for each
 * command in their order, no scan once STOP is acknowledged, a clock that never goes back. */
#include "tactomo_device.h"
#include "unframe.h"

#include <string.h>

static uint32_t timer_us;
static size_t room_left;
static uint8_t received[1 << 20];
static size_t read_at, write_at;

static tactomo_parser heard; /* reads what the device reads */
static uint8_t expected[65536][2];
static size_t commanded, acknowledged;
static bool is_stopped;
static uint64_t newest_us;

static uint32_t microseconds(void *board)
{
    (void)board;
    return timer_us;
}

static size_t receive(void *board, uint8_t *bytes, size_t n)
{
    tactomo_command command;
    (void)board;
    assert(n == 1);
    if (read_at == write_at)
        return 0;
    *bytes = received[read_at++];
    if (tactomo_parser_byte(&heard, *bytes, &command)) {
        expected[commanded][0] = command.request;
        expected[commanded][1] = command.code;
        commanded++;
    }
    return 1;
}

static size_t room(void *board)
{
    (void)board;
    return room_left;
}

static void check_acknowledgement(const uint8_t *payload)
{
    assert(acknowledged < commanded);
    assert(memcmp(payload + 2, expected[acknowledged], 2) == 0);
    assert(payload[4] <= TACTOMO_BUSY);
    acknowledged++;
    if (payload[3] == TACTOMO_STOP)
        is_stopped = true;
    if (payload[3] == TACTOMO_START && payload[4] == TACTOMO_OK)
        is_stopped = false;
}

static void transmit(void *board, const uint8_t *bytes, size_t n)
{
    uint8_t payload[256];
    (void)board;
    assert(n <= room_left);
    room_left -= n;
    unframe(bytes, n, payload);
    if (payload[1] == TACTOMO_ACKNOWLEDGE)
        check_acknowledgement(payload);
    else if (payload[1] == TACTOMO_SCAN)
        assert(!is_stopped);
    else
        assert(payload[1] == TACTOMO_HELLO);
}

static const tactomo_hardware hardware = {microseconds, receive, room, transmit, NULL, NULL};

static void begin(tactomo_device *device, uint8_t choice)
{
    static uint8_t frame[TACTOMO_HELLO_BOUND];
    tactomo_settings settings = {
        {3, TACTOMO_INT16, 4, 4, 1, 1, 1e-6, choice & 4 ? 50.0 : 0.0, "fuzzed", "1"},
        (tactomo_role)(choice % 3), choice & 8 ? 1000 : 0, frame, sizeof frame};
    timer_us = (uint32_t)choice << 24;
    room_left = read_at = write_at = commanded = acknowledged = 0;
    newest_us = 0;
    is_stopped = true;
    tactomo_parser_begin(&heard);
    assert(tactomo_device_begin(device, &settings, &hardware));
}

/* Noise, and sound commands of known and unknown codes, with rates that may be kept and not. */
static void receive_noise(const uint8_t *bytes, size_t n)
{
    memcpy(received + write_at, bytes, n);
    write_at += n;
}

static void receive_command(uint8_t amount)
{
    static const double rates[4] = {20.0, 1e9, -1.0, 1e-9};
    tactomo_frame frame;
    tactomo_frame_begin(&frame, received + write_at, TACTOMO_COMMAND_BOUND, TACTOMO_COMMAND);
    tactomo_frame_u8(&frame, amount & 7);
    tactomo_frame_u8(&frame, amount);
    tactomo_frame_f64(&frame, rates[amount >> 3 & 3]);
    write_at += tactomo_frame_end(&frame);
}

/* One step: what happens, and by how much. */
static void step(tactomo_device *device, uint8_t what, uint8_t amount)
{
    static const int16_t samples[4] = {1, 0, -1, 2};
    static uint32_t counter;
    switch (what % 9) {
    case 0: receive_command(amount); break;
    case 1: timer_us += amount; break;
    case 2: timer_us += (uint32_t)amount << 14; break;
    case 3: room_left += amount; break;
    case 4: tactomo_device_poll(device); break;
    case 5: counter = tactomo_device_begin_scan(device); break;
    case 6: tactomo_device_send_scan(device, counter, amount & 1, timer_us - amount, 0, samples);
        break;
    case 7: receive_noise(&amount, 1); break;
    default: device->busy = amount & 1; break;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    tactomo_device device;
    if (n < 1 || n > 65536)
        return 0;
    begin(&device, data[0]);
    for (size_t i = 1; i + 1 < n; i += 2) {
        step(&device, data[i], data[i + 1]);
        assert(tactomo_device_us(&device) >= newest_us);
        newest_us = tactomo_device_us(&device);
    }
    room_left = sizeof received;
    tactomo_device_poll(&device);
    assert(acknowledged == commanded);
    return 0;
}
