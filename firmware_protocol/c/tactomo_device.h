/* What ../PROTOCOL.md asks of every device, without the hardware: hello every second, commands
 * acknowledged in order and before scans, whole frames or none, counter, 64-bit clock, flags.
 *
 * One tactomo_device is one port. The firmware's main loop owns it: it polls it, takes scans when
 * they are due and hands them over. The one function for interrupts is tactomo_device_begin_scan,
 * so that a pulse on the sync line may number scans. See example_firmware.c.
 */
#ifndef TACTOMO_DEVICE_H
#define TACTOMO_DEVICE_H

#include "tactomo_protocol.h"

/* What the firmware's author supplies. None of these may wait. */
typedef struct {
    /* A timer that counts microseconds through all 32 bits and wraps. */
    uint32_t (*microseconds)(void *board);
    /* Takes up to n received bytes out of a buffer of at least 57; returns how many. */
    size_t (*receive)(void *board, uint8_t *bytes, size_t n);
    /* Free bytes in the transmit buffer, which should hold a dual scan and a hello. */
    size_t (*room)(void *board);
    /* Puts all n bytes into the transmit buffer. Only called where there is room. */
    void (*send)(void *board, const uint8_t *bytes, size_t n);
    /* Does a command that this library does not know and returns a status; may be NULL. */
    uint8_t (*own_command)(void *board, const tactomo_command *command);
    void *board; /* handed to each of them */
} tactomo_hardware;

typedef enum {
    TACTOMO_ALONE,   /* one port, one or both channels */
    TACTOMO_LEADER,  /* one of two ports: gives the pulses of the sync line, also when stopped */
    TACTOMO_FOLLOWER /* the other one: scans on pulses, so its rate is 0 */
} tactomo_role;

typedef struct {
    tactomo_hello hello; /* tactomo_device_announce after changing it */
    tactomo_role role;
    uint32_t shortest_period_us; /* of dual scans; 0 if a trigger from outside sets the rate */
    uint8_t *frame;              /* room for a scan's or a hello's frame, whichever is longer: */
    size_t frame_room;           /* TACTOMO_SCAN_BOUND, TACTOMO_HELLO_BOUND */
} tactomo_settings;

typedef struct {
    tactomo_settings settings;
    const tactomo_hardware *hardware;
    tactomo_parser parser; /* its counts are worth a look when a line is bad */
    bool scanning;         /* between START and STOP; clear it where the host is seen to leave */
    bool busy;             /* set it during a self-test: START, SET_RATE, ZERO_COUNTERS must wait */
    uint32_t dropped;      /* scans for which there was no room */
    /* The rest is the library's own. */
    volatile uint32_t counter; /* of the newest dual scan */
    volatile uint32_t next_counter;
    volatile uint32_t due_us; /* when the newest dual scan was due, by the timer */
    uint32_t next_due_us;
    uint32_t period_us; /* 0 if a trigger from outside sets it */
    uint32_t timer_us;  /* when the clock was last read */
    uint64_t clock_us;
    uint32_t hello_due_us;
    bool hello_wanted;
    bool has_answer; /* an acknowledgement that waits for room */
    uint8_t answer[3];
} tactomo_device;

/* After power-up or reset: stopped, clock and counter at zero, hello at the first poll. Returns
 * false where the hello breaks a rule of the specification, its rate is beyond the shortest period,
 * or the frame buffer is too small. */
bool tactomo_device_begin(tactomo_device *device, const tactomo_settings *settings,
                          const tactomo_hardware *hardware);

/* Answers commands and says hello. Call it at least every 20 ms, during scans as well. */
void tactomo_device_poll(tactomo_device *device);

/* Whether the next dual scan should begin now. Never for a follower, whose pulses say so, nor where
 * a trigger from outside does. A leader's is due also when it is stopped: for the pulse. */
bool tactomo_device_is_due(const tactomo_device *device);

/* A dual scan begins: at each one that is taken and, with a sync line, at each pulse. Returns its
 * counter. A leader makes the pulse of counter 0 a long one. May be called from an interrupt. */
uint32_t tactomo_device_begin_scan(tactomo_device *device);

/* A follower's pulse was a long one: the dual scan that it began has counter 0, which is returned. */
uint32_t tactomo_device_zero_counter(tactomo_device *device);

/* Sends one channel's scan of the dual scan `counter`. `started_us` is the timer when its first
 * sample was taken, not half an hour ago. LATE is added to `flags` where the scan took longer, or
 * leaves later, than the rate allows. Returns false where it was dropped: stopped, or no room for
 * the whole frame. */
bool tactomo_device_send_scan(tactomo_device *device, uint32_t counter, uint8_t channel,
                              uint32_t started_us, uint8_t flags, const void *samples);

/* Sends one reading of a companion, such as a load cell; call it before the scan that begins after
 * the reading was taken. `taken_us` is the timer then. Returns false where it was dropped: stopped,
 * no room, or a value that is not finite. */
bool tactomo_device_send_companion(tactomo_device *device, uint8_t index, uint32_t taken_us,
                                   uint8_t flags, float value);

/* Says hello at once: one of its fields has changed. Returns false where it breaks a rule of the
 * specification; no scan is sent until it keeps them again. */
bool tactomo_device_announce(tactomo_device *device);

/* The clock: microseconds since begin. */
uint64_t tactomo_device_us(tactomo_device *device);

#endif
