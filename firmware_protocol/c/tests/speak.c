/* The library by the line: each line of standard input is a request, and each gets one line back.
 *
 * Frames:  scan CHANNEL FLAGS COUNTER DEVICE_US FORMAT COUNT SAMPLES     -> frame
 *          hello CHANNELS FORMAT SAMPLES ELECTRODES DRIVE MEASURE VOLTS RATE ID FIRMWARE
 *          acknowledge REQUEST COMMAND STATUS
 *          companion INDEX FLAGS DEVICE_US VALUE (bits of a float, decimal)
 *          packet TYPE BODY
 *          parse RUN BYTES                       -> counts | commands (code, request, rate)
 * A device on a board without hardware:
 *          begin ROLE RATE SHORTEST_PERIOD TIMER -> 1, or 0 where it refuses
 *          at TIMER; room BYTES; receive BYTES; busy 0|1; poll; announce
 *          sent                                  -> what was sent since the last time
 *          due; begin_scan; zero_counter; send COUNTER CHANNEL STARTED FLAGS; state
 *          send_companion INDEX TAKEN FLAGS VALUE
 *
 * Bytes are hex, "-" for none; samples are hex of little-endian values; doubles are hex of their 64
 * bits; other numbers are decimal.
 */
#define _XOPEN_SOURCE 700

#include "tactomo_device.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_BYTES = 1 << 20, DEVICE_SAMPLES = 4 };

static uint8_t bytes[MAX_BYTES];
static uint8_t out[TACTOMO_SCAN_BOUND(TACTOMO_MOST_SAMPLES, 4)];

/* --- Words of a line -------------------------------------------------------------------------- */

static const char *word(void)
{
    const char *next = strtok(NULL, " \n");
    return next == NULL ? "-" : next;
}

static uint64_t whole(void)
{
    return strtoull(word(), NULL, 10);
}

static uint8_t byte(void)
{
    return (uint8_t)whole();
}

static double real(void)
{
    uint64_t bits = strtoull(word(), NULL, 16);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static uint8_t nibble(char digit)
{
    return (uint8_t)(digit <= '9' ? digit - '0' : digit - 'a' + 10);
}

static size_t hex(uint8_t *into)
{
    const char *text = word();
    size_t n = *text == '-' ? 0 : strlen(text) / 2;
    for (size_t i = 0; i < n; i++)
        into[i] = (uint8_t)(nibble(text[2 * i]) << 4 | nibble(text[2 * i + 1]));
    return n;
}

static const char *text(char *into)
{
    into[hex((uint8_t *)into)] = '\0';
    return into;
}

static void print_hex(const uint8_t *from, size_t n)
{
    for (size_t i = 0; i < n; i++)
        printf("%02x", from[i]);
    puts(n == 0 ? "-" : "");
}

/* --- Frames ----------------------------------------------------------------------------------- */

/* Samples as the machine keeps them, at an odd address: the library must not mind. */
static const void *native_samples(uint8_t sample_format, size_t n)
{
    static uint8_t kept[1 + 4 * TACTOMO_MOST_SAMPLES];
    size_t size = sample_format == TACTOMO_INT16 ? 2 : 4;
    for (size_t i = 0; i < n / size && i < TACTOMO_MOST_SAMPLES; i++) {
        const uint8_t *at = bytes + i * size;
        uint16_t half = (uint16_t)(at[0] | at[1] << 8);
        uint32_t value = half | (uint32_t)at[size - 2] << 16 | (uint32_t)at[size - 1] << 24;
        memcpy(kept + 1 + i * size, size == 2 ? (const void *)&half : (const void *)&value, size);
    }
    return kept + 1;
}

static void scan(void)
{
    tactomo_scan fields;
    fields.channel = byte();
    fields.flags = byte();
    fields.counter = (uint32_t)whole();
    fields.device_us = whole();
    fields.sample_format = byte();
    fields.count = (uint16_t)whole();
    fields.samples = native_samples(fields.sample_format, hex(bytes));
    print_hex(out, tactomo_encode_scan(&fields, out, sizeof out));
}

static void hello(void)
{
    static char texts[2][1024];
    tactomo_hello fields;
    fields.channels = byte();
    fields.sample_format = byte();
    fields.samples_per_scan = (uint16_t)whole();
    fields.electrodes = byte();
    fields.drive_offset = byte();
    fields.measure_offset = byte();
    fields.volts_per_count = real();
    fields.scan_rate_hz = real();
    fields.device_id = text(texts[0]);
    fields.firmware = text(texts[1]);
    print_hex(out, tactomo_encode_hello(&fields, out, sizeof out));
}

static void acknowledge(void)
{
    uint8_t request = byte(), command = byte(), status = byte();
    print_hex(out, tactomo_encode_acknowledge(request, command, status, out, sizeof out));
}

static float single(void)
{
    uint32_t bits = (uint32_t)whole();
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void companion(void)
{
    tactomo_companion fields;
    fields.index = byte();
    fields.flags = byte();
    fields.device_us = whole();
    fields.value = single();
    print_hex(out, tactomo_encode_companion(&fields, out, sizeof out));
}

static void packet(void)
{
    tactomo_frame frame;
    uint8_t type = byte();
    size_t n = hex(bytes);
    tactomo_frame_begin(&frame, out, sizeof out, type);
    tactomo_frame_bytes(&frame, bytes, n);
    print_hex(out, tactomo_frame_end(&frame));
}

static void print_command(const tactomo_command *command)
{
    uint64_t bits;
    memcpy(&bits, &command->rate_hz, sizeof bits);
    printf(" %u,%u,%016" PRIx64, command->code, command->request, bits);
}

static void print_counts(const tactomo_counts *counts)
{
    printf(" | %" PRIu32 " %" PRIu32 " %" PRIu32 " %" PRIu32 " %" PRIu32 " %" PRIu32 " %" PRIu32
           "\n", counts->packets, counts->crc_errors, counts->cobs_errors, counts->malformed,
           counts->oversize, counts->wrong_version, counts->unknown_type);
}

static void parse(void)
{
    size_t run = (size_t)whole(), n = hex(bytes);
    tactomo_parser parser;
    tactomo_command command;
    bool found;
    tactomo_parser_begin(&parser);
    for (size_t i = 0; i < n;) {
        i += tactomo_parser_run(&parser, bytes + i, run < n - i ? run : n - i, &command, &found);
        if (found)
            print_command(&command);
    }
    print_counts(&parser.counts);
}

/* --- A device whose board is made of variables ------------------------------------------------- */

static tactomo_device device;
static uint32_t timer_us;
static size_t room_left, received_at, received_end, sent_bytes;
static uint8_t received[65536], sent[MAX_BYTES], frame[TACTOMO_HELLO_BOUND];

static uint32_t microseconds(void *board)
{
    (void)board;
    return timer_us;
}

static size_t receive(void *board, uint8_t *into, size_t n)
{
    size_t taken = n < received_end - received_at ? n : received_end - received_at;
    (void)board;
    memcpy(into, received + received_at, taken);
    received_at += taken;
    return taken;
}

static size_t room(void *board)
{
    (void)board;
    return room_left;
}

static void transmit(void *board, const uint8_t *from, size_t n)
{
    (void)board;
    if (n > room_left)
        abort();
    room_left -= n;
    memcpy(sent + sent_bytes, from, n);
    sent_bytes += n;
}

static uint8_t own_command(void *board, const tactomo_command *command)
{
    (void)board;
    return command->code == 0xF0 ? command->argument[0] : (uint8_t)TACTOMO_UNKNOWN_COMMAND;
}

static const tactomo_hardware hardware = {microseconds, receive, room, transmit, own_command, NULL};

static void begin(void)
{
    tactomo_settings settings;
    settings.role = (tactomo_role)whole();
    settings.hello = (tactomo_hello){
        3, TACTOMO_INT16, DEVICE_SAMPLES, 4, 1, 1, 1e-6, real(), "board", "1"};
    settings.shortest_period_us = (uint32_t)whole();
    settings.frame = frame;
    settings.frame_room = sizeof frame;
    timer_us = (uint32_t)whole();
    room_left = sizeof sent;
    received_at = received_end = sent_bytes = 0;
    printf("%d\n", tactomo_device_begin(&device, &settings, &hardware));
}

static void send_scan(void)
{
    static const int16_t samples[DEVICE_SAMPLES] = {1, -1, 0, 32767};
    uint32_t counter = (uint32_t)whole();
    uint8_t channel = byte();
    uint32_t started_us = (uint32_t)whole();
    printf("%d\n", tactomo_device_send_scan(&device, counter, channel, started_us, byte(),
                                            samples));
}

static void send_companion(void)
{
    uint8_t index = byte();
    uint32_t taken_us = (uint32_t)whole();
    uint8_t flags = byte();
    printf("%d\n", tactomo_device_send_companion(&device, index, taken_us, flags, single()));
}

static void take_sent(void)
{
    print_hex(sent, sent_bytes);
    sent_bytes = 0;
}

static void print_state(void)
{
    printf("%d %" PRIu32 " %" PRIu64 "\n", device.scanning, device.dropped,
           tactomo_device_us(&device));
}

static void act(const char *request)
{
    if (strcmp(request, "at") == 0)
        printf("%" PRIu32 "\n", timer_us = (uint32_t)whole());
    else if (strcmp(request, "room") == 0)
        printf("%zu\n", room_left = (size_t)whole());
    else if (strcmp(request, "receive") == 0)
        printf("%zu\n", received_end += hex(received + received_end));
    else if (strcmp(request, "busy") == 0)
        printf("%d\n", device.busy = whole() != 0);
    else if (strcmp(request, "due") == 0)
        printf("%d\n", tactomo_device_is_due(&device));
    else if (strcmp(request, "begin_scan") == 0)
        printf("%" PRIu32 "\n", tactomo_device_begin_scan(&device));
    else if (strcmp(request, "zero_counter") == 0)
        printf("%" PRIu32 "\n", tactomo_device_zero_counter(&device));
    else if (strcmp(request, "announce") == 0)
        printf("%d\n", tactomo_device_announce(&device));
    else if (strcmp(request, "poll") == 0)
        tactomo_device_poll(&device), puts("-");
    else
        puts("what?");
}

int main(void)
{
    static const struct {
        const char *request;
        void (*answer)(void);
    } known[] = {{"scan", scan},   {"hello", hello}, {"acknowledge", acknowledge},
                 {"packet", packet}, {"parse", parse}, {"begin", begin},
                 {"companion", companion}, {"send_companion", send_companion},
                 {"send", send_scan}, {"sent", take_sent}, {"state", print_state}};
    static char line[2 * MAX_BYTES];
    while (fgets(line, sizeof line, stdin) != NULL) {
        const char *request = strtok(line, " \n");
        size_t i = 0;
        while (i < sizeof known / sizeof *known && strcmp(request, known[i].request) != 0)
            i++;
        if (i < sizeof known / sizeof *known)
            known[i].answer();
        else
            act(request);
        fflush(stdout);
    }
    return 0;
}
