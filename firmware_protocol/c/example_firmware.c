/* A firmware's main loop: one board, one port, both channels of the paper's sensor, 20 dual scans a
 * second. Copy it, and write the eight board_ functions for your hardware.
 *
 * For two boards see README.md: the leader gives a pulse where this loop begins a scan, the follower
 * begins one in that pulse's interrupt.
 */
#include "tactomo_device.h"

/* --- What your board supplies ----------------------------------------------------------------- */

void board_begin(void);                                  /* clocks, pins, converter, UART or USB */
uint32_t board_microseconds(void);                       /* a 32-bit timer at 1 MHz, free-running */
size_t board_receive(uint8_t *bytes, size_t n);          /* from the receive interrupt's buffer */
size_t board_room(void);                                 /* free bytes of the transmit buffer */
void board_send(const uint8_t *bytes, size_t n);         /* into it; an interrupt or DMA empties it */
void board_drive(uint8_t channel, uint8_t from, uint8_t to); /* current in here, out there; settled */
int32_t board_measure(uint8_t plus, uint8_t minus);      /* the voltage between two electrodes */
const char *board_id(void);                              /* UTF-8, unique and lasting */

/* --- The sensor ------------------------------------------------------------------------------- */

enum { ELECTRODES = 16, SAMPLES = ELECTRODES * (ELECTRODES - 3) };
enum { CONVERTER_LIMIT = 8388607 }; /* 24 bits */

static tactomo_device device;
static int32_t samples[SAMPLES];
static uint8_t frame[TACTOMO_SCAN_BOUND(SAMPLES, sizeof(int32_t))];

static uint8_t next(uint8_t electrode)
{
    return (uint8_t)((electrode + 1) % ELECTRODES);
}

static bool is_driven(uint8_t electrode, uint8_t drive)
{
    return electrode == drive || electrode == next(drive);
}

/* Adjacent drive, adjacent measurement, in the order of PROTOCOL.md; returns the scan's flags.
 * Commands are answered between two drives, however long a scan takes. */
static uint8_t scan_channel(uint8_t channel)
{
    uint8_t flags = 0;
    int32_t *sample = samples;
    for (uint8_t drive = 0; drive < ELECTRODES; drive++) {
        board_drive(channel, drive, next(drive));
        for (uint8_t m = 0; m < ELECTRODES; m++) {
            if (is_driven(m, drive) || is_driven(next(m), drive))
                continue;
            *sample = board_measure(m, next(m));
            if (*sample >= CONVERTER_LIMIT || *sample <= -CONVERTER_LIMIT)
                flags |= TACTOMO_SATURATED;
            sample++;
        }
        tactomo_device_poll(&device);
    }
    return flags;
}

static void scan_both(void)
{
    uint32_t counter = tactomo_device_begin_scan(&device);
    for (uint8_t channel = TACTOMO_MAGNITUDE; channel <= TACTOMO_STRUCTURE; channel++) {
        uint32_t started_us = board_microseconds();
        uint8_t flags = scan_channel(channel);
        tactomo_device_send_scan(&device, counter, channel, started_us, flags, samples);
    }
}

/* --- The library meets the board -------------------------------------------------------------- */

static uint32_t microseconds(void *board)
{
    (void)board;
    return board_microseconds();
}

static size_t receive(void *board, uint8_t *bytes, size_t n)
{
    (void)board;
    return board_receive(bytes, n);
}

static size_t room(void *board)
{
    (void)board;
    return board_room();
}

static void send(void *board, const uint8_t *bytes, size_t n)
{
    (void)board;
    board_send(bytes, n);
}

static const tactomo_hardware hardware = {microseconds, receive, room, send, NULL, NULL};

static bool begin(void)
{
    tactomo_settings settings = {
        .hello =
            {
                .channels = 1 << TACTOMO_MAGNITUDE | 1 << TACTOMO_STRUCTURE,
                .sample_format = TACTOMO_INT32,
                .samples_per_scan = SAMPLES,
                .electrodes = ELECTRODES,
                .drive_offset = 1,
                .measure_offset = 1,
                .volts_per_count = 0.5 / CONVERTER_LIMIT,
                .scan_rate_hz = 20.0,
                .device_id = board_id(),
                .firmware = "1.0.0",
            },
        .role = TACTOMO_ALONE,
        .shortest_period_us = 20000,
        .frame = frame,
        .frame_room = sizeof frame,
    };
    return tactomo_device_begin(&device, &settings, &hardware);
}

int main(void)
{
    board_begin();
    if (!begin())
        return 1; /* a field of hello is not as PROTOCOL.md wants it: see tactomo_device_begin */
    for (;;) {
        tactomo_device_poll(&device);
        if (tactomo_device_is_due(&device))
            scan_both();
    }
}
