/* A skin without hardware: the firmware library behind pseudo-terminals, for POSIX systems.
 *
 * Everything that goes over the line is made and read by tactomo_device.c and tactomo_protocol.c,
 * as on a microcontroller. Here are only the pieces of a board: a timer, a converter, a receive and
 * a transmit buffer, a sync line, and faults to order. `--help` says what can be asked for.
 */
#define _XOPEN_SOURCE 700
#define _DEFAULT_SOURCE

#include "tactomo_device.h"

#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { MAX_BOARDS = 2, TRANSMIT_BYTES = 12288, CONVERTER_LIMIT = 8388607 };
enum { FASTEST_PERIOD_US = 1000, POLL_MS = 1, LONGEST_PATH = 4096 };
enum { BAD_USAGE = 2, MAX_SCENES = 16 };

static const char help[] =
    "Usage: tactomo_emulator [OPTIONS] [VOLTAGES.csv ...]\n"
    "\n"
    "A tactile skin without hardware: the C firmware library behind pseudo-terminals.\n"
    "Prints a path for each port; the daemon reads them like any serial device:\n"
    "\n"
    "  tactomo_emulator --link /tmp/skin &\n"
    "  tactomo daemon --port /tmp/skin/port0\n"
    "\n"
    "VOLTAGES.csv holds one dual scan a line: the magnitude channel's voltages, then the\n"
    "structure channel's, in volts, separated by commas or blanks; a # begins a comment.\n"
    "Its lines are sent in turn, over and over. Enter goes on to the next file, and after the\n"
    "last one to the first: give a bare skin and a pressed one, and Enter presses and lifts.\n"
    "README.md shows how to make them. Without a file the skin rests: an even disc.\n"
    "\n"
    "The skin:\n"
    "  --ports 1|2        one port for both channels, or two boards with a sync line [1]\n"
    "  --rate HZ          dual scans a second, at most 1000 [20]\n"
    "  --electrodes N     4 to 33; N (N - 3) voltages a channel [16]\n"
    "  --noise VOLTS      standard deviation, added to each voltage [0.000002]\n"
    "  --full-scale VOLTS where the converter saturates [0.5]\n"
    "  --link FOLDER      also link the ports there as port0, port1: names that stay\n"
    "  --id TEXT          what the boards call themselves; a name that begins with twin\n"
    "                     marks a simulated skin [twin-emulator]\n"
    "\n"
    "Faults:\n"
    "  --drop N           every Nth dual scan is taken and not sent: a gap in the counter\n"
    "  --corrupt N        in every Nth frame one bit is flipped on the line\n"
    "  --drift PPM        the first board's clock is fast, the second one's slow, by this\n"
    "  --away SECONDS     how long the boards stay unplugged after SIGUSR1 [1]\n"
    "\n"
    "Signals:\n"
    "  SIGHUP             reset: stopped, clock and counter at zero\n"
    "  SIGUSR1            unplug, and plug in again\n"
    "  SIGUSR2            reset the last board alone: its counter no longer fits the other's\n"
    "  SIGSTOP, SIGCONT   a device that is there and says nothing\n"
    "  SIGINT, SIGTERM    remove the links and end\n";

typedef struct {
    int ports;
    int electrodes;
    double rate_hz;
    double noise_v;
    double full_scale_v;
    double drift_ppm;
    double away_s;
    unsigned long drop_every;
    unsigned long corrupt_every;
    const char *link_folder;
    const char *id;
    char **files; /* ends with NULL */
} options;

/* Voltages to replay: lines of channels * samples, in volts. */
typedef struct {
    double *volts;
    size_t lines;
    size_t samples;
    size_t channels;
} scene;

typedef struct {
    tactomo_device device;
    tactomo_hardware hardware;
    char id[TACTOMO_LONGEST_TEXT + 1];
    char link[LONGEST_PATH];
    uint8_t channels; /* as in hello */
    int line;         /* the board's end of the pseudo-terminal */
    int host_end;     /* held open, so that the board does not see when nobody listens */
    double us_per_us; /* how fast its clock runs */
    unsigned long corrupt_every;
    unsigned long frames;
    bool was_scanning;
    size_t unsent;
    uint8_t transmit[TRANSMIT_BYTES];
    uint8_t frame[TACTOMO_SCAN_BOUND(TACTOMO_MOST_SAMPLES, 4)];
} board;

static board boards[MAX_BOARDS];
static int32_t samples[TACTOMO_MOST_SAMPLES];
static uint64_t random_state = 0x9E3779B97F4A7C15u;

static volatile sig_atomic_t ending, reset_all, reset_last, unplug;

static void say(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vfprintf(stderr, format, arguments);
    va_end(arguments);
    fputc('\n', stderr);
}

static void fail(const char *what, const char *next)
{
    say("tactomo_emulator: %s: %s\n  %s", what, strerror(errno), next);
    exit(EXIT_FAILURE);
}

static void refuse(const char *what, const char *value)
{
    say("tactomo_emulator: %s: %s\n  tactomo_emulator --help shows what is possible", what, value);
    exit(BAD_USAGE);
}

/* --- Chance (xorshift64), and the noise of a converter ---------------------------------------- */

static double uniform(void)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (double)(random_state >> 11) / 9007199254740992.0;
}

static double normal(void)
{
    return sqrt(-2.0 * log(1.0 - uniform())) * cos(6.283185307179586 * uniform());
}

/* --- The board's timer, receive buffer and transmit buffer ------------------------------------- */

static double elapsed_us(void)
{
    static struct timespec start;
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    if (start.tv_sec == 0)
        start = now;
    return (double)(now.tv_sec - start.tv_sec) * 1e6 +
           (double)(now.tv_nsec - start.tv_nsec) / 1e3;
}

static uint32_t microseconds(void *context)
{
    const board *self = context;
    return (uint32_t)(uint64_t)(elapsed_us() * self->us_per_us);
}

static size_t receive(void *context, uint8_t *bytes, size_t n)
{
    const board *self = context;
    ssize_t got = self->line < 0 ? -1 : read(self->line, bytes, n);
    return got > 0 ? (size_t)got : 0;
}

static size_t room(void *context)
{
    const board *self = context;
    return TRANSMIT_BYTES - self->unsent;
}

static void corrupt(board *self, uint8_t *frame, size_t n)
{
    self->frames++;
    if (self->corrupt_every > 0 && self->frames % self->corrupt_every == 0)
        frame[(size_t)(uniform() * (double)n)] ^= (uint8_t)(1 << (int)(uniform() * 8));
}

static void transmit(void *context, const uint8_t *bytes, size_t n)
{
    board *self = context;
    memcpy(self->transmit + self->unsent, bytes, n);
    corrupt(self, self->transmit + self->unsent, n);
    self->unsent += n;
}

/* What a UART's interrupt or a USB endpoint does: as much as the line takes, without waiting. */
static void empty_transmit_buffer(board *self)
{
    ssize_t sent;
    if (self->line < 0 || self->unsent == 0)
        return;
    sent = write(self->line, self->transmit, self->unsent);
    if (sent <= 0)
        return;
    self->unsent -= (size_t)sent;
    memmove(self->transmit, self->transmit + sent, self->unsent);
}

/* --- The port --------------------------------------------------------------------------------- */

static void make_raw(int terminal)
{
    struct termios settings;
    if (tcgetattr(terminal, &settings) != 0)
        fail("a pseudo-terminal has no settings", "tell the maintainers");
    cfmakeraw(&settings);
    tcsetattr(terminal, TCSANOW, &settings);
}

/* A link that a killed emulator left behind is replaced; a file of somebody else's is not. */
static void make_link(const char *link, const char *path)
{
    struct stat there;
    if (lstat(link, &there) == 0 && S_ISLNK(there.st_mode))
        unlink(link);
    if (symlink(path, link) != 0)
        fail(link, "give --link a folder that is there, that you may write to, without such a file");
}

static void plug_in(board *self)
{
    const char *path;
    self->line = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (self->line < 0 || grantpt(self->line) != 0 || unlockpt(self->line) != 0 ||
        (path = ptsname(self->line)) == NULL)
        fail("no pseudo-terminal", "mount devpts, or end programs that hold many");
    self->host_end = open(path, O_RDWR | O_NOCTTY);
    if (self->host_end < 0)
        fail(path, "check the rights of /dev/pts");
    make_raw(self->host_end);
    self->unsent = 0;
    if (self->link[0] != '\0')
        make_link(self->link, path);
    printf("%s\n", self->link[0] != '\0' ? self->link : path);
    fflush(stdout);
}

static void pull_out(board *self)
{
    if (self->link[0] != '\0')
        unlink(self->link);
    close(self->host_end);
    close(self->line);
    self->line = self->host_end = -1;
}

/* --- The skin --------------------------------------------------------------------------------- */

/* Potential at an angle on the rim of an even disc, of a current in at `from` and out at `to`. */
static double rim_potential(double angle, double from, double to)
{
    return log(fabs(sin((angle - to) / 2))) - log(fabs(sin((angle - from) / 2)));
}

/* The voltages of an even disc, in the order of PROTOCOL.md; the largest is `largest_v`. */
static void rest(double *volts, int electrodes, double largest_v)
{
    double step = 6.283185307179586 / electrodes, largest = 0.0;
    size_t n = 0;
    for (int k = 0; k < electrodes; k++) {
        for (int m = 0; m < electrodes; m++) {
            int after = (m + electrodes - k) % electrodes; /* drive pair: 0 and 1 */
            if (after <= 1 || after == electrodes - 1)
                continue;
            volts[n] = rim_potential(m * step, k * step, (k + 1) * step) -
                       rim_potential((m + 1) * step, k * step, (k + 1) * step);
            largest = fmax(largest, fabs(volts[n]));
            n++;
        }
    }
    for (size_t i = 0; i < n; i++)
        volts[i] *= largest_v / largest;
}

static double *room_for_volts(double *volts, size_t n)
{
    double *longer = realloc(volts, n * sizeof *volts);
    if (longer == NULL)
        fail("no memory for the voltages", "give a shorter file");
    return longer;
}

static scene resting_scene(const options *asked)
{
    scene made = {NULL, 1, (size_t)(asked->electrodes * (asked->electrodes - 3)), 2};
    made.volts = room_for_volts(NULL, 2 * made.samples);
    rest(made.volts, asked->electrodes, asked->full_scale_v / 4);
    rest(made.volts + made.samples, asked->electrodes, asked->full_scale_v / 5);
    return made;
}

/* Appends the numbers of a line; returns how many there are, or -1 where one is no voltage. */
static long read_line(char *line, scene *read, size_t at)
{
    long n = 0;
    line[strcspn(line, "#\r\n")] = '\0';
    for (char *word = strtok(line, ", \t;"); word != NULL; word = strtok(NULL, ", \t;")) {
        char *end;
        double volts = strtod(word, &end);
        if (*end != '\0' || !isfinite(volts))
            return -1;
        read->volts = room_for_volts(read->volts, at + (size_t)n + 1);
        read->volts[at + (size_t)n++] = volts;
    }
    return n;
}

static void check_line(const char *path, const options *asked, const scene *read, size_t number,
                       long n)
{
    char what[160];
    bool fits = n == (long)read->samples || n == 2 * (long)read->samples;
    if (fits && (read->lines == 0 || n == (long)(read->channels * read->samples)))
        return;
    if (n < 0)
        snprintf(what, sizeof what, "line %zu holds something that is no voltage", number);
    else
        snprintf(what, sizeof what, "line %zu has %ld voltages where %zu (or %zu: both channels) "
                 "belong to %d electrodes", number, n, read->samples, 2 * read->samples,
                 asked->electrodes);
    refuse(what, path);
}

static scene load_scene(const char *path, const options *asked)
{
    scene read = {NULL, 0, (size_t)(asked->electrodes * (asked->electrodes - 3)), 2};
    FILE *file = fopen(path, "r");
    char *line = NULL;
    size_t length = 0;
    if (file == NULL)
        fail(path, "give a file of voltages that is there, or none for a skin at rest");
    for (size_t number = 1; getline(&line, &length, file) > 0; number++) {
        long n = read_line(line, &read, read.lines * read.channels * read.samples);
        if (n == 0)
            continue;
        check_line(path, asked, &read, number, n);
        read.channels = (size_t)n / read.samples;
        read.lines++;
    }
    free(line);
    fclose(file);
    if (read.lines == 0)
        refuse("no voltages in", path);
    return read;
}

/* Loads the files, or makes the skin at rest; returns how many scenes there are. */
static size_t load_scenes(const options *asked, scene *into)
{
    size_t n = 0;
    for (; asked->files[n] != NULL && n < MAX_SCENES; n++) {
        into[n] = load_scene(asked->files[n], asked);
        if (into[n].channels < (size_t)asked->ports)
            refuse("two ports need both channels, and one alone is in", asked->files[n]);
        if (into[n].channels != into[0].channels)
            refuse("it has other channels than the first file", asked->files[n]);
    }
    if (asked->files[n] != NULL)
        refuse("that is one file too many", asked->files[n]);
    if (n == 0)
        into[n++] = resting_scene(asked);
    return n;
}

/* Converts one channel of one line into counts; returns the scan's flags. */
static uint8_t convert(const options *asked, const double *volts, size_t n)
{
    uint8_t flags = TACTOMO_SIMULATED;
    for (size_t i = 0; i < n; i++) {
        double counts = (volts[i] + asked->noise_v * normal()) / asked->full_scale_v *
                        CONVERTER_LIMIT;
        if (fabs(counts) >= CONVERTER_LIMIT)
            flags |= TACTOMO_SATURATED;
        counts = fmin(fmax(counts, -CONVERTER_LIMIT), CONVERTER_LIMIT);
        samples[i] = (int32_t)lrint(counts);
    }
    return flags;
}

static void send_channels(board *self, const options *asked, const scene *shown, uint32_t counter,
                          size_t line)
{
    for (uint8_t channel = 0; channel < shown->channels; channel++) {
        const double *volts = shown->volts + (line * shown->channels + channel) * shown->samples;
        uint32_t started_us = microseconds(self);
        uint8_t flags;
        if ((self->channels & 1 << channel) == 0)
            continue;
        flags = convert(asked, volts, shown->samples);
        tactomo_device_send_scan(&self->device, counter, channel, started_us, flags, samples);
    }
}

/* The leader's pulse reaches the follower at once, and a long one zeroes its counter. */
static void scan_all(const options *asked, const scene *shown)
{
    static size_t taken;
    bool is_dropped = asked->drop_every > 0 && (taken + 1) % asked->drop_every == 0;
    uint32_t counter = tactomo_device_begin_scan(&boards[0].device);
    bool is_long_pulse = counter == 0;
    for (int i = 0; i < asked->ports; i++) {
        if (i > 0)
            counter = tactomo_device_begin_scan(&boards[i].device);
        if (i > 0 && is_long_pulse)
            counter = tactomo_device_zero_counter(&boards[i].device);
        if (!is_dropped)
            send_channels(&boards[i], asked, shown, counter, taken % shown->lines);
    }
    taken++;
}

/* --- The boards ------------------------------------------------------------------------------- */

static tactomo_role role_of(const options *asked, int i)
{
    return asked->ports == 1 ? TACTOMO_ALONE : i == 0 ? TACTOMO_LEADER : TACTOMO_FOLLOWER;
}

static void power_up(board *self, const options *asked, const scene *shown)
{
    tactomo_settings settings = {
        .hello = {.channels = self->channels,
                  .sample_format = TACTOMO_INT32,
                  .samples_per_scan = (uint16_t)shown->samples,
                  .electrodes = (uint8_t)asked->electrodes,
                  .drive_offset = 1,
                  .measure_offset = 1,
                  .volts_per_count = asked->full_scale_v / CONVERTER_LIMIT,
                  .scan_rate_hz = asked->rate_hz,
                  .device_id = self->id,
                  .firmware = "tactomo_emulator 1.0"},
        .role = role_of(asked, (int)(self - boards)),
        .shortest_period_us = FASTEST_PERIOD_US,
        .frame = self->frame,
        .frame_room = sizeof self->frame};
    self->was_scanning = false;
    self->unsent = 0;
    if (!tactomo_device_begin(&self->device, &settings, &self->hardware))
        refuse("not possible in a hello", "--id or --rate");
}

static void make_board(board *self, const options *asked, size_t channels)
{
    int i = (int)(self - boards);
    const char *suffix = asked->ports == 1 ? "" : i == 0 ? "/a" : "/b";
    int id_length = snprintf(self->id, sizeof self->id, "%s%s", asked->id, suffix);
    if (id_length < 1 || id_length >= (int)sizeof self->id)
        refuse("an id has 1 to 62 bytes", asked->id);
    if (asked->link_folder != NULL)
        snprintf(self->link, sizeof self->link, "%s/port%d", asked->link_folder, i);
    self->channels = (uint8_t)(asked->ports == 2 ? 1 << i : (1 << channels) - 1);
    self->us_per_us = 1 + (i == 0 ? 1e-6 : -1e-6) * asked->drift_ppm;
    self->corrupt_every = asked->corrupt_every;
    self->hardware = (tactomo_hardware){microseconds, receive, room, transmit, NULL, self};
}

static void tell(board *self, int i)
{
    if (self->device.scanning != self->was_scanning)
        say("port%d: %s", i, self->device.scanning ? "scanning" : "stopped");
    self->was_scanning = self->device.scanning;
}

static void run_away(const options *asked)
{
    struct timespec away = {(time_t)asked->away_s,
                            (long)(fmod(asked->away_s, 1.0) * 1e9)};
    say("unplugged for %g s", asked->away_s);
    for (int i = 0; i < asked->ports; i++)
        pull_out(&boards[i]);
    nanosleep(&away, NULL);
    for (int i = 0; i < asked->ports && !ending; i++)
        plug_in(&boards[i]);
}

/* Returns whether it was asked for; the next time it is not. */
static bool was_asked(volatile sig_atomic_t *wish)
{
    bool was = *wish != 0;
    *wish = 0;
    return was;
}

static void do_what_signals_ask(const options *asked, const scene *shown)
{
    bool unplugged = was_asked(&unplug);
    bool all = was_asked(&reset_all) || unplugged;
    bool last = was_asked(&reset_last) || all;
    if (unplugged)
        run_away(asked);
    for (int i = 0; i < asked->ports; i++) {
        if (!all && !(last && i == asked->ports - 1))
            continue;
        say("port%d: reset", i);
        power_up(&boards[i], asked, shown);
    }
}

/* A program in the background would be stopped for reading its terminal. */
static bool may_read_terminal(void)
{
    return !isatty(STDIN_FILENO) || tcgetpgrp(STDIN_FILENO) == getpgrp();
}

/* Waits for bytes from a host, for a moment; returns whether Enter was pressed meanwhile. */
static bool wait_for_bytes(const options *asked)
{
    static int input = STDIN_FILENO;
    struct pollfd lines[MAX_BOARDS + 1];
    char typed[64];
    ssize_t got;
    for (int i = 0; i < asked->ports; i++)
        lines[i] = (struct pollfd){.fd = boards[i].line, .events = POLLIN};
    lines[asked->ports] = (struct pollfd){.fd = may_read_terminal() ? input : -1, .events = POLLIN};
    if (poll(lines, (nfds_t)asked->ports + 1, POLL_MS) <= 0 || lines[asked->ports].revents == 0)
        return false;
    got = read(input, typed, sizeof typed);
    if (got <= 0)
        input = -1; /* nobody will press it any more */
    return got > 0 && memchr(typed, '\n', (size_t)got) != NULL;
}

static void run(const options *asked, const scene *scenes, size_t scene_count)
{
    const scene *shown = scenes;
    while (!ending) {
        do_what_signals_ask(asked, shown);
        if (tactomo_device_is_due(&boards[0].device))
            scan_all(asked, shown);
        for (int i = 0; i < asked->ports; i++) {
            tactomo_device_poll(&boards[i].device);
            empty_transmit_buffer(&boards[i]);
            tell(&boards[i], i);
        }
        if (wait_for_bytes(asked)) {
            shown = shown + 1 < scenes + scene_count ? shown + 1 : scenes;
            say("showing scene %d of %zu", (int)(shown - scenes) + 1, scene_count);
        }
    }
}

/* --- The command line ------------------------------------------------------------------------- */

static double number(const char *option, const char *text, double low, double high)
{
    char *end;
    double value = strtod(text, &end);
    char what[80];
    if (*text != '\0' && *end == '\0' && value >= low && value <= high)
        return value;
    snprintf(what, sizeof what, "%s takes a number from %g to %g, not", option, low, high);
    refuse(what, text);
    return low;
}

static void set_option(options *asked, int letter)
{
    switch (letter) {
    case 'p': asked->ports = (int)number("--ports", optarg, 1, 2); break;
    case 'r': asked->rate_hz = number("--rate", optarg, 0.01, 1000); break;
    case 'e': asked->electrodes = (int)number("--electrodes", optarg, 4, 33); break;
    case 'n': asked->noise_v = number("--noise", optarg, 0, 1e6); break;
    case 'f': asked->full_scale_v = number("--full-scale", optarg, 1e-6, 1e6); break;
    case 'l': asked->link_folder = optarg; break;
    case 'i': asked->id = optarg; break;
    case 'd': asked->drop_every = (unsigned long)number("--drop", optarg, 1, 1e9); break;
    case 'c': asked->corrupt_every = (unsigned long)number("--corrupt", optarg, 1, 1e9); break;
    case 't': asked->drift_ppm = number("--drift", optarg, -1e5, 1e5); break;
    case 'a': asked->away_s = number("--away", optarg, 0, 3600); break;
    case 'h': fputs(help, stdout); exit(EXIT_SUCCESS);
    default: say("  tactomo_emulator --help shows what is possible"); exit(BAD_USAGE);
    }
}

static options read_options(int argc, char **argv)
{
    static const struct option known[] = {
        {"ports", required_argument, NULL, 'p'},      {"rate", required_argument, NULL, 'r'},
        {"electrodes", required_argument, NULL, 'e'}, {"noise", required_argument, NULL, 'n'},
        {"full-scale", required_argument, NULL, 'f'}, {"link", required_argument, NULL, 'l'},
        {"id", required_argument, NULL, 'i'},         {"drop", required_argument, NULL, 'd'},
        {"corrupt", required_argument, NULL, 'c'},    {"drift", required_argument, NULL, 't'},
        {"away", required_argument, NULL, 'a'},       {"help", no_argument, NULL, 'h'},
        {NULL, 0, NULL, 0}};
    options asked = {.ports = 1, .electrodes = 16, .rate_hz = 20, .noise_v = 2e-6,
                     .full_scale_v = 0.5, .away_s = 1, .id = "twin-emulator"};
    int letter;
    while ((letter = getopt_long(argc, argv, "h", known, NULL)) != -1)
        set_option(&asked, letter);
    asked.files = argv + optind;
    return asked;
}

static void note_signal(int signal_number)
{
    ending |= signal_number == SIGINT || signal_number == SIGTERM;
    reset_all |= signal_number == SIGHUP;
    reset_last |= signal_number == SIGUSR2;
    unplug |= signal_number == SIGUSR1;
}

static void listen_to_signals(void)
{
    static const int heard[] = {SIGINT, SIGTERM, SIGHUP, SIGUSR1, SIGUSR2};
    struct sigaction action = {.sa_handler = note_signal};
    for (size_t i = 0; i < sizeof heard / sizeof *heard; i++)
        sigaction(heard[i], &action, NULL);
}

int main(int argc, char **argv)
{
    options asked = read_options(argc, argv);
    scene scenes[MAX_SCENES];
    size_t scene_count = load_scenes(&asked, scenes);
    listen_to_signals();
    for (int i = 0; i < asked.ports; i++) {
        make_board(&boards[i], &asked, scenes->channels);
        power_up(&boards[i], &asked, scenes);
        plug_in(&boards[i]);
    }
    run(&asked, scenes, scene_count);
    for (int i = 0; i < asked.ports; i++)
        if (boards[i].line >= 0)
            pull_out(&boards[i]);
    while (scene_count > 0)
        free(scenes[--scene_count].volts);
    return EXIT_SUCCESS;
}
