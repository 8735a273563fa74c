/* The wire protocol of ../PROTOCOL.md, version 1, for a device: writes frames, reads commands.
 *
 * Portable C99. No allocation, no global state, nothing of the C library but memcpy; any byte
 * order; no unaligned access. Functions may be called from different threads or interrupts as long
 * as each works on structures of its own. `double` must have 8 bytes (on AVR: -mdouble=64).
 */
#ifndef TACTOMO_PROTOCOL_H
#define TACTOMO_PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { TACTOMO_VERSION = 1 };

/* Packet types. */
enum {
    TACTOMO_SCAN = 0x01,
    TACTOMO_HELLO = 0x02,
    TACTOMO_ACKNOWLEDGE = 0x03,
    TACTOMO_COMPANION = 0x04,
    TACTOMO_COMMAND = 0x81
};

enum { TACTOMO_MAGNITUDE = 0, TACTOMO_STRUCTURE = 1 }; /* channels */

/* Sample formats: int16_t, int32_t, float. */
enum { TACTOMO_INT16 = 1, TACTOMO_INT32 = 2, TACTOMO_FLOAT32 = 3 };

/* Flags of a scan, and but for LATE of a companion's reading. */
enum { TACTOMO_SATURATED = 0x01, TACTOMO_LATE = 0x02, TACTOMO_SIMULATED = 0x04 };

/* Codes of commands. */
enum {
    TACTOMO_IDENTIFY = 1,
    TACTOMO_START = 2,
    TACTOMO_STOP = 3,
    TACTOMO_SET_RATE = 4,
    TACTOMO_ZERO_COUNTERS = 5
};

/* Statuses of an acknowledgement. */
enum {
    TACTOMO_OK = 0,
    TACTOMO_UNKNOWN_COMMAND = 1,
    TACTOMO_BAD_ARGUMENT = 2,
    TACTOMO_BUSY = 3
};

enum {
    TACTOMO_MOST_SAMPLES = 1024,
    TACTOMO_LONGEST_TEXT = 64,      /* bytes of device_id and of firmware */
    TACTOMO_LONGEST_ENCODED = 4137, /* bytes between two delimiters */
    TACTOMO_COMMAND_PAYLOAD = 16,
    TACTOMO_CLOCK_BITS = 53 /* of device_us: 285 years */
};

/* Rates that a hello may state, beside 0. */
#define TACTOMO_LOWEST_RATE_HZ 1e-3
#define TACTOMO_HIGHEST_RATE_HZ 1e6

/* Bytes of a frame, both delimiters included, are at most: */
#define TACTOMO_FRAME_BOUND(payload) ((payload) + ((payload) + 253) / 254 + 2)
#define TACTOMO_SCAN_BOUND(count, sample_bytes) TACTOMO_FRAME_BOUND(24 + (count) * (sample_bytes))
#define TACTOMO_HELLO_BOUND TACTOMO_FRAME_BOUND(31 + 2 * TACTOMO_LONGEST_TEXT)
#define TACTOMO_ACKNOWLEDGE_BOUND TACTOMO_FRAME_BOUND(9)
#define TACTOMO_COMPANION_BOUND TACTOMO_FRAME_BOUND(20)
#define TACTOMO_COMMAND_BOUND TACTOMO_FRAME_BOUND(TACTOMO_COMMAND_PAYLOAD)

/* --- Writing ---------------------------------------------------------------------------------- */

/* One channel's samples of one scan. */
typedef struct {
    uint8_t channel;
    uint8_t flags;
    uint8_t sample_format;
    uint16_t count;     /* samples, 1 to 1024 */
    uint32_t counter;   /* of dual scans */
    uint64_t device_us; /* when the first sample was taken, µs since power-up; below 2^53 */
    const void *samples; /* int16_t, int32_t or float, as sample_format says */
} tactomo_scan;

/* Who the device is and how its scans are to be read. */
typedef struct {
    uint8_t channels; /* on this port: bit 0 magnitude, bit 1 structure */
    uint8_t sample_format;
    uint16_t samples_per_scan;
    uint8_t electrodes;
    uint8_t drive_offset;
    uint8_t measure_offset;
    double volts_per_count; /* V */
    double scan_rate_hz;    /* 0 if a trigger from outside sets it, else 0.001 to 1e6 */
    const char *device_id;  /* UTF-8, 1 to 64 bytes: unique and lasting */
    const char *firmware;   /* likewise: its version, for people */
} tactomo_hello;

/* One reading of a companion, such as a load cell beneath the sheets. */
typedef struct {
    uint8_t index; /* which companion */
    uint8_t flags;
    uint64_t device_us; /* when it was taken, by the clock of the scans; below 2^53 */
    float value;        /* finite, in the companion's own unit */
} tactomo_companion;

/* Each writes one frame with both delimiters and returns its size in bytes; 0 where the packet
 * breaks a rule of the specification, or `room` is too small for it. The samples are read once and
 * go straight to `out`. */
size_t tactomo_encode_scan(const tactomo_scan *scan, uint8_t *out, size_t room);
size_t tactomo_encode_hello(const tactomo_hello *hello, uint8_t *out, size_t room);
size_t tactomo_encode_acknowledge(uint8_t request, uint8_t command, uint8_t status, uint8_t *out,
                                  size_t room);
size_t tactomo_encode_companion(const tactomo_companion *reading, uint8_t *out, size_t room);

/* The same piece by piece, for packet types of your own (0x70 to 0x7F): begin, append, end. */
typedef struct {
    uint8_t *out;
    size_t room;
    size_t size;
    size_t code_at; /* where the code of the COBS block that is being filled belongs */
    uint32_t crc;
    bool overflowed;
} tactomo_frame;

void tactomo_frame_begin(tactomo_frame *frame, uint8_t *out, size_t room, uint8_t type);
void tactomo_frame_bytes(tactomo_frame *frame, const void *bytes, size_t n);
void tactomo_frame_u8(tactomo_frame *frame, uint8_t value);
void tactomo_frame_u16(tactomo_frame *frame, uint16_t value);
void tactomo_frame_u32(tactomo_frame *frame, uint32_t value);
void tactomo_frame_u64(tactomo_frame *frame, uint64_t value);
void tactomo_frame_f64(tactomo_frame *frame, double value);
size_t tactomo_frame_end(tactomo_frame *frame); /* bytes; 0 if they did not fit */

/* --- Reading ---------------------------------------------------------------------------------- */

typedef struct {
    uint8_t code;
    uint8_t request;
    uint8_t argument[8]; /* as sent, for commands of your own (0xF0 to 0xFF) */
    double rate_hz;      /* of SET_RATE, which may be NaN; 0 otherwise */
} tactomo_command;

/* What became of the frames. A device knows one type, so all others count as unknown. */
typedef struct {
    uint32_t packets; /* sound ones, unknown types included */
    uint32_t crc_errors;
    uint32_t cobs_errors;
    uint32_t malformed;
    uint32_t oversize;
    uint32_t wrong_version;
    uint32_t unknown_type;
} tactomo_counts;

/* Decodes bytes as they come and keeps the first sixteen of a payload, so that frames of any length
 * are counted as the specification says although none is stored. */
typedef struct {
    tactomo_counts counts;
    uint32_t crc;
    uint16_t encoded;   /* bytes since the last delimiter */
    uint16_t decoded;   /* payload bytes in them */
    uint8_t block_left; /* bytes that the COBS block still has to give */
    bool zero_follows;  /* once the block is done, unless the frame ends there */
    bool in_step;       /* a delimiter has come since the port was opened */
    uint8_t payload[TACTOMO_COMMAND_PAYLOAD];
} tactomo_parser;

void tactomo_parser_begin(tactomo_parser *parser);

/* Takes one byte; returns whether it completes a command, which is then in `command`. */
bool tactomo_parser_byte(tactomo_parser *parser, uint8_t byte, tactomo_command *command);

/* Takes bytes up to the first complete command, or all. Returns how many; `found` says which. */
size_t tactomo_parser_run(tactomo_parser *parser, const uint8_t *bytes, size_t n,
                          tactomo_command *command, bool *found);

#endif
