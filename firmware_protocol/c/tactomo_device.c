#include "tactomo_device.h"

#define HELLO_EVERY_US 1000000u
#define LONGEST_PERIOD_US 1000000000u /* half the timer's range, and somewhat less */

static uint32_t timer(const tactomo_device *device)
{
    return device->hardware->microseconds(device->hardware->board);
}

/* Right while less than half the timer's range, 35 minutes, lies between the two. */
static bool has_come(uint32_t due_us, uint32_t now_us)
{
    return now_us - due_us < 0x80000000u;
}

uint64_t tactomo_device_us(tactomo_device *device)
{
    uint32_t now_us = timer(device);
    device->clock_us += now_us - device->timer_us;
    device->timer_us = now_us;
    return device->clock_us;
}

/* --- Beginning -------------------------------------------------------------------------------- */

static bool is_external(const tactomo_settings *settings)
{
    return settings->role == TACTOMO_FOLLOWER || settings->shortest_period_us == 0 ||
           settings->hello.scan_rate_hz == 0.0;
}

static bool is_too_fast(const tactomo_settings *settings, double rate_hz)
{
    return rate_hz > 1e6 / settings->shortest_period_us;
}

/* Division and comparison are all the double arithmetic here: the rest would cost 5 KB on an M0+. */
static uint32_t nearest_period_us(double rate_hz)
{
    double halves = 2e6 / rate_hz;
    return halves < 2.0 * LONGEST_PERIOD_US ? ((uint32_t)halves + 1) / 2 : LONGEST_PERIOD_US;
}

static void keep_period(tactomo_device *device, uint32_t period_us)
{
    device->period_us = period_us;
    device->settings.hello.scan_rate_hz = 1e6 / period_us;
}

static size_t encode_hello(const tactomo_settings *settings)
{
    return tactomo_encode_hello(&settings->hello, settings->frame, settings->frame_room);
}

static bool fits_frame(const tactomo_settings *settings)
{
    uint8_t format = settings->hello.sample_format;
    size_t sample_bytes = format == TACTOMO_INT16 ? 2 : 4;
    size_t scan = TACTOMO_SCAN_BOUND(settings->hello.samples_per_scan * sample_bytes, 1u);
    return scan <= settings->frame_room && encode_hello(settings) > 0;
}

static bool begin_pacing(tactomo_device *device)
{
    tactomo_settings *settings = &device->settings;
    if (is_external(settings)) {
        settings->hello.scan_rate_hz = 0.0;
        return true;
    }
    if (is_too_fast(settings, settings->hello.scan_rate_hz))
        return false;
    keep_period(device, nearest_period_us(settings->hello.scan_rate_hz));
    return true;
}

bool tactomo_device_begin(tactomo_device *device, const tactomo_settings *settings,
                          const tactomo_hardware *hardware)
{
    if (!fits_frame(settings))
        return false;
    *device = (tactomo_device){.settings = *settings, .hardware = hardware};
    tactomo_parser_begin(&device->parser);
    device->timer_us = device->next_due_us = device->hello_due_us = timer(device);
    return begin_pacing(device);
}

/* --- Speaking: an answer that waits goes first, then hello, then scans ------------------------ */

static bool send_frame(tactomo_device *device, size_t size)
{
    const tactomo_hardware *hardware = device->hardware;
    if (size == 0 || hardware->room(hardware->board) < size)
        return false;
    hardware->send(hardware->board, device->settings.frame, size);
    return true;
}

static bool send_answer(tactomo_device *device)
{
    const uint8_t *answer = device->answer;
    size_t size = tactomo_encode_acknowledge(answer[0], answer[1], answer[2],
                                             device->settings.frame, device->settings.frame_room);
    return send_frame(device, size);
}

static void keep_time_of_hello(tactomo_device *device)
{
    uint32_t now_us = timer(device);
    if (!has_come(device->hello_due_us, now_us))
        return;
    device->hello_wanted = true;
    device->hello_due_us += HELLO_EVERY_US;
    if (has_come(device->hello_due_us, now_us)) /* nobody polled for a second */
        device->hello_due_us = now_us + HELLO_EVERY_US;
}

/* Returns whether nothing is left to be said before a scan. */
static bool speak(tactomo_device *device)
{
    keep_time_of_hello(device);
    if (device->has_answer)
        device->has_answer = !send_answer(device);
    if (device->hello_wanted && !device->has_answer)
        device->hello_wanted = !send_frame(device, encode_hello(&device->settings));
    return !device->has_answer && !device->hello_wanted;
}

bool tactomo_device_announce(tactomo_device *device)
{
    device->hello_wanted = true;
    return encode_hello(&device->settings) > 0;
}

/* --- Obeying ---------------------------------------------------------------------------------- */

static uint8_t start(tactomo_device *device)
{
    if (device->busy)
        return TACTOMO_BUSY;
    if (!device->scanning && device->settings.role == TACTOMO_ALONE)
        device->next_due_us = timer(device);
    device->scanning = true;
    return TACTOMO_OK;
}

static uint8_t set_rate(tactomo_device *device, double rate_hz)
{
    if (is_external(&device->settings))
        return TACTOMO_UNKNOWN_COMMAND;
    if (!(rate_hz > 0.0) || is_too_fast(&device->settings, rate_hz))
        return TACTOMO_BAD_ARGUMENT;
    if (device->busy)
        return TACTOMO_BUSY;
    keep_period(device, nearest_period_us(rate_hz));
    device->next_due_us = timer(device);
    device->hello_wanted = true;
    return TACTOMO_OK;
}

static uint8_t zero_counters(tactomo_device *device)
{
    if (device->settings.role == TACTOMO_FOLLOWER)
        return TACTOMO_UNKNOWN_COMMAND;
    if (device->busy)
        return TACTOMO_BUSY;
    device->next_counter = 0;
    return TACTOMO_OK;
}

static uint8_t obey(tactomo_device *device, const tactomo_command *command)
{
    const tactomo_hardware *hardware = device->hardware;
    switch (command->code) {
    case TACTOMO_IDENTIFY:
        device->hello_wanted = true;
        return TACTOMO_OK;
    case TACTOMO_START:
        return start(device);
    case TACTOMO_STOP:
        device->scanning = false;
        return TACTOMO_OK;
    case TACTOMO_SET_RATE:
        return set_rate(device, command->rate_hz);
    case TACTOMO_ZERO_COUNTERS:
        return zero_counters(device);
    default:
        return hardware->own_command == NULL ? (uint8_t)TACTOMO_UNKNOWN_COMMAND
                                             : hardware->own_command(hardware->board, command);
    }
}

static void listen_to(tactomo_device *device, uint8_t byte)
{
    tactomo_command command;
    if (!tactomo_parser_byte(&device->parser, byte, &command))
        return;
    device->answer[0] = command.request;
    device->answer[1] = command.code;
    device->answer[2] = obey(device, &command);
    device->has_answer = true;
}

void tactomo_device_poll(tactomo_device *device)
{
    const tactomo_hardware *hardware = device->hardware;
    uint8_t byte;
    tactomo_device_us(device); /* the timer must not wrap unseen */
    speak(device);
    /* While an answer waits for room, further commands wait in the receive buffer. */
    while (!device->has_answer && hardware->receive(hardware->board, &byte, 1) == 1) {
        listen_to(device, byte);
        if (device->has_answer)
            speak(device);
    }
}

/* --- Scanning --------------------------------------------------------------------------------- */

bool tactomo_device_is_due(const tactomo_device *device)
{
    tactomo_role role = device->settings.role;
    bool paces = role == TACTOMO_LEADER || (role == TACTOMO_ALONE && device->scanning);
    return paces && device->period_us > 0 && has_come(device->next_due_us, timer(device));
}

uint32_t tactomo_device_begin_scan(tactomo_device *device)
{
    uint32_t now_us = timer(device);
    uint32_t counter = device->next_counter;
    device->counter = counter;
    device->next_counter = counter + 1;
    device->due_us = now_us;
    if (device->period_us > 0 && has_come(device->next_due_us, now_us)) {
        device->due_us = device->next_due_us;
        device->next_due_us += device->period_us;
        if (has_come(device->next_due_us, now_us)) /* missed ones are not made up */
            device->next_due_us = now_us + device->period_us;
    }
    return counter;
}

uint32_t tactomo_device_zero_counter(tactomo_device *device)
{
    device->counter = 0;
    device->next_counter = 1;
    return 0;
}

/* A newer one has begun, or more than a period has passed since this one was due or began. */
static bool is_late(const tactomo_device *device, uint32_t counter, uint32_t started_us)
{
    uint32_t now_us = timer(device), period_us = device->period_us;
    return counter != device->counter ||
           (period_us > 0 && (now_us - device->due_us > period_us || now_us - started_us > period_us));
}

static uint64_t clock_at(tactomo_device *device, uint32_t timer_us)
{
    uint64_t now_us = tactomo_device_us(device);
    return now_us - (uint32_t)(device->timer_us - timer_us);
}

bool tactomo_device_send_scan(tactomo_device *device, uint32_t counter, uint8_t channel,
                              uint32_t started_us, uint8_t flags, const void *samples)
{
    const tactomo_settings *settings = &device->settings;
    tactomo_scan scan;
    if (!device->scanning)
        return false;
    scan.channel = channel;
    scan.flags = is_late(device, counter, started_us) ? (uint8_t)(flags | TACTOMO_LATE) : flags;
    scan.sample_format = settings->hello.sample_format;
    scan.count = settings->hello.samples_per_scan;
    scan.counter = counter;
    scan.device_us = clock_at(device, started_us);
    scan.samples = samples;
    if (speak(device) && send_frame(device, tactomo_encode_scan(&scan, settings->frame,
                                                                settings->frame_room)))
        return true;
    device->dropped++;
    return false;
}

bool tactomo_device_send_companion(tactomo_device *device, uint8_t index, uint32_t taken_us,
                                   uint8_t flags, float value)
{
    const tactomo_settings *settings = &device->settings;
    tactomo_companion reading;
    if (!device->scanning)
        return false;
    reading.index = index;
    reading.flags = flags;
    reading.device_us = clock_at(device, taken_us);
    reading.value = value;
    return speak(device) && send_frame(device, tactomo_encode_companion(&reading, settings->frame,
                                                                        settings->frame_room));
}
