/* Any bytes at all: each frame between two delimiters ends in exactly one count, and runs of bytes
 * give the same as single bytes. */
#include "tactomo_protocol.h"
#include "unframe.h"

#include <string.h>

static uint32_t frames_in(const uint8_t *data, size_t n)
{
    uint32_t frames = 0;
    size_t start = 0;
    while (start < n && data[start] != 0)
        start++;
    for (size_t i = ++start; i < n; i++) {
        if (data[i] != 0 && i - start != TACTOMO_LONGEST_ENCODED)
            continue;
        if (data[i] != 0) {
            frames++; /* oversize: counted before its end has come */
        } else {
            frames += i > start && i - start <= TACTOMO_LONGEST_ENCODED;
            start = i + 1;
        }
    }
    return frames;
}

static uint32_t all(const tactomo_counts *counts)
{
    return counts->packets + counts->crc_errors + counts->cobs_errors + counts->malformed +
           counts->oversize + counts->wrong_version;
}

static uint32_t digest(uint32_t before, const tactomo_command *command)
{
    uint8_t bytes[2] = {command->code, command->request};
    return before * 31 + checksum(bytes, 2) + checksum(command->argument, 8);
}

static uint32_t parse_bytes(tactomo_parser *parser, const uint8_t *data, size_t n)
{
    tactomo_command command;
    uint32_t commands = 0;
    for (size_t i = 0; i < n; i++)
        if (tactomo_parser_byte(parser, data[i], &command))
            commands = digest(commands, &command);
    return commands;
}

static uint32_t parse_runs(tactomo_parser *parser, const uint8_t *data, size_t n, size_t run)
{
    tactomo_command command;
    uint32_t commands = 0;
    for (size_t i = 0; i < n;) {
        bool found;
        i += tactomo_parser_run(parser, data + i, run < n - i ? run : n - i, &command, &found);
        if (found)
            commands = digest(commands, &command);
    }
    return commands;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t n)
{
    tactomo_parser by_bytes, by_runs;
    size_t run = n > 0 ? (size_t)data[0] + 1 : 1;
    tactomo_parser_begin(&by_bytes);
    tactomo_parser_begin(&by_runs);
    assert(parse_bytes(&by_bytes, data, n) == parse_runs(&by_runs, data, n, run));
    assert(memcmp(&by_bytes.counts, &by_runs.counts, sizeof by_runs.counts) == 0);
    assert(all(&by_bytes.counts) == frames_in(data, n));
    return 0;
}
