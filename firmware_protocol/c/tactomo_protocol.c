#include "tactomo_protocol.h"

#include <float.h>
#include <string.h>

typedef char tactomo_needs_a_double_of_8_bytes[sizeof(double) == 8 ? 1 : -1];
typedef char tactomo_needs_a_float_of_4_bytes[sizeof(float) == 4 ? 1 : -1];

/* --- CRC-32, half a byte at a time: 64 bytes of table ----------------------------------------- */

enum { DELIMITER = 0, FULL_BLOCK = 255, SHORTEST_PAYLOAD = 6 };

#define CRC_START 0xFFFFFFFFu
#define CRC_AFTER_CHECKSUM 0xDEBB20E3u /* the register, once a sound checksum has gone through it */

static uint32_t crc_add(uint32_t crc, uint8_t byte)
{
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u,
        0x4DB26158u, 0x5005713Cu, 0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu,
        0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    crc ^= byte;
    crc = crc >> 4 ^ table[crc & 15];
    return crc >> 4 ^ table[crc & 15];
}

/* --- Writing frames --------------------------------------------------------------------------- */

static void append(tactomo_frame *frame, uint8_t byte)
{
    if (frame->size < frame->room)
        frame->out[frame->size++] = byte;
    else
        frame->overflowed = true;
}

static void close_block(tactomo_frame *frame)
{
    if (!frame->overflowed)
        frame->out[frame->code_at] = (uint8_t)(frame->size - frame->code_at);
}

static void open_block(tactomo_frame *frame)
{
    frame->code_at = frame->size;
    append(frame, 0); /* its code, once that is known */
}

/* A full block is closed when more follows, so none is opened in vain at the payload's end. */
static void stuff(tactomo_frame *frame, uint8_t byte)
{
    if (frame->size - frame->code_at == FULL_BLOCK) {
        close_block(frame);
        open_block(frame);
    }
    if (byte != 0) {
        append(frame, byte);
    } else {
        close_block(frame);
        open_block(frame);
    }
}

void tactomo_frame_begin(tactomo_frame *frame, uint8_t *out, size_t room, uint8_t type)
{
    frame->out = out;
    frame->room = room;
    frame->size = 0;
    frame->crc = CRC_START;
    frame->overflowed = false;
    append(frame, DELIMITER);
    open_block(frame);
    tactomo_frame_u8(frame, TACTOMO_VERSION);
    tactomo_frame_u8(frame, type);
}

void tactomo_frame_u8(tactomo_frame *frame, uint8_t value)
{
    frame->crc = crc_add(frame->crc, value);
    stuff(frame, value);
}

void tactomo_frame_bytes(tactomo_frame *frame, const void *bytes, size_t n)
{
    const uint8_t *at = bytes;
    for (size_t i = 0; i < n; i++)
        tactomo_frame_u8(frame, at[i]);
}

void tactomo_frame_u16(tactomo_frame *frame, uint16_t value)
{
    tactomo_frame_u8(frame, (uint8_t)(value & 0xFF));
    tactomo_frame_u8(frame, (uint8_t)(value >> 8));
}

void tactomo_frame_u32(tactomo_frame *frame, uint32_t value)
{
    tactomo_frame_u16(frame, (uint16_t)(value & 0xFFFF));
    tactomo_frame_u16(frame, (uint16_t)(value >> 16));
}

void tactomo_frame_u64(tactomo_frame *frame, uint64_t value)
{
    tactomo_frame_u32(frame, (uint32_t)(value & 0xFFFFFFFFu));
    tactomo_frame_u32(frame, (uint32_t)(value >> 32));
}

void tactomo_frame_f64(tactomo_frame *frame, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    tactomo_frame_u64(frame, bits);
}

size_t tactomo_frame_end(tactomo_frame *frame)
{
    uint32_t checksum = frame->crc ^ 0xFFFFFFFFu;
    tactomo_frame_u32(frame, checksum);
    close_block(frame);
    append(frame, DELIMITER);
    return frame->overflowed ? 0 : frame->size;
}

/* --- Packets ---------------------------------------------------------------------------------- */

static bool is_format(uint8_t sample_format)
{
    return sample_format >= TACTOMO_INT16 && sample_format <= TACTOMO_FLOAT32;
}

static bool is_count(uint16_t samples)
{
    return samples >= 1 && samples <= TACTOMO_MOST_SAMPLES;
}

static void put_samples(tactomo_frame *frame, const tactomo_scan *scan)
{
    const uint8_t *at = scan->samples;
    size_t size = scan->sample_format == TACTOMO_INT16 ? 2 : 4;
    for (uint16_t i = 0; i < scan->count; i++, at += size) {
        uint16_t half;
        uint32_t whole;
        if (size == 2) {
            memcpy(&half, at, sizeof half);
            tactomo_frame_u16(frame, half);
        } else {
            memcpy(&whole, at, sizeof whole);
            tactomo_frame_u32(frame, whole);
        }
    }
}

size_t tactomo_encode_scan(const tactomo_scan *scan, uint8_t *out, size_t room)
{
    tactomo_frame frame;
    if (scan->channel > TACTOMO_STRUCTURE || !is_format(scan->sample_format) ||
        !is_count(scan->count) || scan->device_us >> TACTOMO_CLOCK_BITS != 0)
        return 0;
    tactomo_frame_begin(&frame, out, room, TACTOMO_SCAN);
    tactomo_frame_u8(&frame, scan->channel);
    tactomo_frame_u8(&frame, scan->flags);
    tactomo_frame_u32(&frame, scan->counter);
    tactomo_frame_u64(&frame, scan->device_us);
    tactomo_frame_u8(&frame, scan->sample_format);
    tactomo_frame_u8(&frame, 0); /* reserved */
    tactomo_frame_u16(&frame, scan->count);
    put_samples(&frame, scan);
    return tactomo_frame_end(&frame);
}

/* The range of the second byte of a UTF-8 character and the number of bytes after its first; none
 * for a byte that starts no character (Unicode, table 3-7). C1 controls are left out, too. */
static uint8_t utf8_tail(uint8_t first, uint8_t *low, uint8_t *high)
{
    *low = first == 0xE0 || first == 0xC2 ? 0xA0 : first == 0xF0 ? 0x90 : 0x80;
    *high = first == 0xED ? 0x9F : first == 0xF4 ? 0x8F : 0xBF;
    return first < 0xC2 ? 0 : first < 0xE0 ? 1 : first < 0xF0 ? 2 : first < 0xF5 ? 3 : 0;
}

/* Length in bytes of a text that may be sent: UTF-8 without control characters; 0 for others. */
static uint8_t text_length(const char *text)
{
    uint8_t length = 0, left = 0, low = 0, high = 0;
    for (; text[length] != '\0'; length++) {
        uint8_t byte = (uint8_t)text[length];
        if (length == TACTOMO_LONGEST_TEXT)
            return 0;
        if (left > 0) {
            if (byte < low || byte > high)
                return 0;
            left--;
            low = 0x80;
            high = 0xBF;
        } else if (byte < 0x20 || byte == 0x7F) {
            return 0;
        } else if (byte >= 0x80) {
            left = utf8_tail(byte, &low, &high);
            if (left == 0)
                return 0;
        }
    }
    return left == 0 ? length : 0;
}

static bool is_finite(double value)
{
    return value >= -DBL_MAX && value <= DBL_MAX;
}

static bool is_offset(uint8_t offset, uint8_t electrodes)
{
    return offset >= 1 && offset < electrodes;
}

static bool is_sound_hello(const tactomo_hello *hello)
{
    return hello->channels >= 1 && hello->channels <= 3 && is_format(hello->sample_format) &&
           is_count(hello->samples_per_scan) && hello->electrodes >= 2 &&
           is_offset(hello->drive_offset, hello->electrodes) &&
           is_offset(hello->measure_offset, hello->electrodes) &&
           is_finite(hello->volts_per_count) && hello->volts_per_count > 0.0 &&
           (hello->scan_rate_hz == 0.0 || (hello->scan_rate_hz >= TACTOMO_LOWEST_RATE_HZ &&
                                           hello->scan_rate_hz <= TACTOMO_HIGHEST_RATE_HZ));
}

static void put_text(tactomo_frame *frame, const char *text, uint8_t length)
{
    tactomo_frame_u8(frame, length);
    tactomo_frame_bytes(frame, text, length);
}

size_t tactomo_encode_hello(const tactomo_hello *hello, uint8_t *out, size_t room)
{
    tactomo_frame frame;
    uint8_t id_length = text_length(hello->device_id);
    uint8_t firmware_length = text_length(hello->firmware);
    if (!is_sound_hello(hello) || id_length == 0 || firmware_length == 0)
        return 0;
    tactomo_frame_begin(&frame, out, room, TACTOMO_HELLO);
    tactomo_frame_u8(&frame, hello->channels);
    tactomo_frame_u8(&frame, hello->sample_format);
    tactomo_frame_u16(&frame, hello->samples_per_scan);
    tactomo_frame_u8(&frame, hello->electrodes);
    tactomo_frame_u8(&frame, hello->drive_offset);
    tactomo_frame_f64(&frame, hello->volts_per_count);
    tactomo_frame_f64(&frame, hello->scan_rate_hz);
    tactomo_frame_u8(&frame, hello->measure_offset);
    put_text(&frame, hello->device_id, id_length);
    put_text(&frame, hello->firmware, firmware_length);
    return tactomo_frame_end(&frame);
}

size_t tactomo_encode_acknowledge(uint8_t request, uint8_t command, uint8_t status, uint8_t *out,
                                  size_t room)
{
    tactomo_frame frame;
    if (status > TACTOMO_BUSY)
        return 0;
    tactomo_frame_begin(&frame, out, room, TACTOMO_ACKNOWLEDGE);
    tactomo_frame_u8(&frame, request);
    tactomo_frame_u8(&frame, command);
    tactomo_frame_u8(&frame, status);
    return tactomo_frame_end(&frame);
}

size_t tactomo_encode_companion(const tactomo_companion *reading, uint8_t *out, size_t room)
{
    tactomo_frame frame;
    uint32_t bits;
    if (!is_finite((double)reading->value) || reading->device_us >> TACTOMO_CLOCK_BITS != 0)
        return 0;
    memcpy(&bits, &reading->value, sizeof bits);
    tactomo_frame_begin(&frame, out, room, TACTOMO_COMPANION);
    tactomo_frame_u8(&frame, reading->index);
    tactomo_frame_u8(&frame, reading->flags);
    tactomo_frame_u64(&frame, reading->device_us);
    tactomo_frame_u32(&frame, bits);
    return tactomo_frame_end(&frame);
}

/* --- Reading commands ------------------------------------------------------------------------- */

static void start_frame(tactomo_parser *parser)
{
    parser->crc = CRC_START;
    parser->encoded = 0;
    parser->decoded = 0;
    parser->block_left = 0;
    parser->zero_follows = false;
    parser->in_step = true;
}

void tactomo_parser_begin(tactomo_parser *parser)
{
    memset(parser, 0, sizeof *parser);
}

static void take(tactomo_parser *parser, uint8_t byte)
{
    if (parser->decoded < TACTOMO_COMMAND_PAYLOAD)
        parser->payload[parser->decoded] = byte;
    parser->decoded++;
    parser->crc = crc_add(parser->crc, byte);
}

static void unstuff(tactomo_parser *parser, uint8_t byte)
{
    if (parser->block_left > 0) {
        parser->block_left--;
        take(parser, byte);
        return;
    }
    if (parser->zero_follows)
        take(parser, 0);
    parser->block_left = (uint8_t)(byte - 1);
    parser->zero_follows = byte != FULL_BLOCK;
}

static void collect(tactomo_parser *parser, uint8_t byte)
{
    if (parser->encoded > TACTOMO_LONGEST_ENCODED)
        return; /* counted already */
    parser->encoded++;
    if (parser->encoded > TACTOMO_LONGEST_ENCODED)
        parser->counts.oversize++;
    else
        unstuff(parser, byte);
}

static double read_f64(const uint8_t *bytes)
{
    uint64_t bits = 0;
    double value;
    for (int i = 7; i >= 0; i--)
        bits = bits << 8 | bytes[i];
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void read_command(const uint8_t *payload, tactomo_command *command)
{
    command->code = payload[2];
    command->request = payload[3];
    memcpy(command->argument, payload + 4, sizeof command->argument);
    command->rate_hz = command->code == TACTOMO_SET_RATE ? read_f64(command->argument) : 0.0;
}

/* Steps 3 to 7 of PROTOCOL.md, "Receiving"; returns whether the frame is a command. */
static bool judge(tactomo_parser *parser)
{
    tactomo_counts *counts = &parser->counts;
    if (parser->encoded == 0 || parser->encoded > TACTOMO_LONGEST_ENCODED)
        return false;
    if (parser->block_left > 0) {
        counts->cobs_errors++;
    } else if (parser->decoded < SHORTEST_PAYLOAD || parser->crc != CRC_AFTER_CHECKSUM) {
        counts->crc_errors++;
    } else if (parser->payload[0] != TACTOMO_VERSION) {
        counts->wrong_version++;
    } else if (parser->payload[1] != TACTOMO_COMMAND) {
        counts->unknown_type++;
        counts->packets++;
    } else if (parser->decoded != TACTOMO_COMMAND_PAYLOAD) {
        counts->malformed++;
    } else {
        counts->packets++;
        return true;
    }
    return false;
}

bool tactomo_parser_byte(tactomo_parser *parser, uint8_t byte, tactomo_command *command)
{
    bool is_command = false;
    if (byte != DELIMITER) {
        if (parser->in_step)
            collect(parser, byte);
        return false;
    }
    if (parser->in_step && judge(parser)) {
        read_command(parser->payload, command);
        is_command = true;
    }
    start_frame(parser);
    return is_command;
}

size_t tactomo_parser_run(tactomo_parser *parser, const uint8_t *bytes, size_t n,
                          tactomo_command *command, bool *found)
{
    size_t i = 0;
    *found = false;
    while (i < n && !*found)
        *found = tactomo_parser_byte(parser, bytes[i++], command);
    return i;
}
