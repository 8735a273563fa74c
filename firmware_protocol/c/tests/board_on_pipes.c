/* A board for example_firmware.c: its line is standard input and output, its samples tell where in
 * the pattern they belong. */
#define _XOPEN_SOURCE 700

#include <fcntl.h>
#include <poll.h>
#include <stdint.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

void board_begin(void);
uint32_t board_microseconds(void);
size_t board_receive(uint8_t *bytes, size_t n);
size_t board_room(void);
void board_send(const uint8_t *bytes, size_t n);
void board_drive(uint8_t channel, uint8_t from, uint8_t to);
int32_t board_measure(uint8_t plus, uint8_t minus);
const char *board_id(void);

static int32_t driven; /* channel and drive pair, for samples that tell where they come from */

void board_begin(void)
{
    fcntl(STDIN_FILENO, F_SETFL, O_NONBLOCK);
}

uint32_t board_microseconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)((uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u);
}

/* The end of input is power-off. */
size_t board_receive(uint8_t *bytes, size_t n)
{
    ssize_t got = read(STDIN_FILENO, bytes, n);
    if (got == 0)
        exit(0);
    return got > 0 ? (size_t)got : 0;
}

size_t board_room(void)
{
    struct pollfd output = {STDOUT_FILENO, POLLOUT, 0};
    return poll(&output, 1, 0) == 1 ? 4096 : 0; /* a pipe that can be written takes as much */
}

void board_send(const uint8_t *bytes, size_t n)
{
    if (write(STDOUT_FILENO, bytes, n) != (ssize_t)n)
        exit(1);
}

void board_drive(uint8_t channel, uint8_t from, uint8_t to)
{
    driven = channel << 24 | from << 16 | to << 8;
}

int32_t board_measure(uint8_t plus, uint8_t minus)
{
    return (plus + 1) % 16 == minus ? driven | plus : -1;
}

const char *board_id(void)
{
    return "twin-example";
}
