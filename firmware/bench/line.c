/* A host that is not there hears nothing, as on a real line; a host that is slow is waited for, by whoever calls. */
#define _GNU_SOURCE
#include "line.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

static uint32_t held(const struct queue *q) { return q->last - q->first; }

static void put(struct queue *q, uint8_t byte) { q->byte[q->last++ % LINE_ROOM] = byte; }

static uint8_t get(struct queue *q) { return q->byte[q->first++ % LINE_ROOM]; }

int line_open(struct line *line, uint64_t seed)
{
    memset(line, 0, sizeof *line);
    noise_seed(&line->noise, seed);
    line->terminal = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (line->terminal < 0 || grantpt(line->terminal) != 0 || unlockpt(line->terminal) != 0 ||
        ptsname_r(line->terminal, line->name, sizeof line->name) != 0) {
        fprintf(stderr, "amb_bench: no pseudo-terminal: %s\n", strerror(errno));
        return -1;
    }
    /* Raw from the start; opened and closed once, after which a hang-up tells that no host has it open. */
    const int other = open(line->name, O_RDWR | O_NOCTTY | O_CLOEXEC);
    struct termios how;
    if (other < 0 || tcgetattr(other, &how) != 0) {
        fprintf(stderr, "amb_bench: %s: %s\n", line->name, strerror(errno));
        return -1;
    }
    cfmakeraw(&how);
    tcsetattr(other, TCSANOW, &how);
    close(other);
    fcntl(line->terminal, F_SETFL, fcntl(line->terminal, F_GETFL) | O_NONBLOCK);
    return 0;
}

void line_close(struct line *line)
{
    if (line->terminal >= 0)
        close(line->terminal);
    line->terminal = -1;
}

static uint8_t through(struct line *line, uint8_t byte)
{
    if (line->damage > 0.0 && noise_uniform(&line->noise) < line->damage) {
        line->damaged++;
        byte ^= (uint8_t)(1u << (noise_bits(&line->noise) & 7u));
    }
    return byte;
}

void line_say(struct line *line, uint8_t byte)
{
    if (line->cable != CABLE_SOUND)
        line->vanished++;
    else if (!line->heard)
        line->unheard++;
    else {
        line->sent++;
        put(&line->to_host, through(line, byte));
    }
}

int line_next(struct line *line)
{
    if (held(&line->to_controller) == 0)
        return -1;
    const uint8_t byte = get(&line->to_controller);
    if (line->cable != CABLE_SOUND) {
        line->vanished++;
        return -1;
    }
    line->received++;
    return through(line, byte);
}

int line_waiting(const struct line *line) { return (int)held(&line->to_controller); }

int line_unsent(const struct line *line) { return (int)held(&line->to_host); }

static void see_who_is_there(struct line *line)
{
    struct pollfd here = {.fd = line->terminal, .events = 0};
    if (poll(&here, 1, 0) < 0)
        return;
    line->heard = !(here.revents & POLLHUP);
    line->opened |= line->heard;
    if (!line->heard && held(&line->to_host) > 0) {
        line->unheard += held(&line->to_host);
        line->sent -= held(&line->to_host);
        line->to_host.first = line->to_host.last;
    }
}

int line_move(struct line *line)
{
    see_who_is_there(line);
    while (held(&line->to_host) > 0) {
        const uint32_t from = line->to_host.first % LINE_ROOM;
        const uint32_t most = LINE_ROOM - from;
        const uint32_t n = held(&line->to_host) < most ? held(&line->to_host) : most;
        const ssize_t done = write(line->terminal, line->to_host.byte + from, n);
        if (done <= 0)
            break;
        line->to_host.first += (uint32_t)done;
    }
    int came = 0;
    while (held(&line->to_controller) < LINE_ROOM / 2) {
        uint8_t some[512];
        const ssize_t n = read(line->terminal, some, sizeof some);
        if (n <= 0)
            break;
        for (ssize_t k = 0; k < n; k++)
            put(&line->to_controller, some[k]);
        came += (int)n;
    }
    if (came > 0)
        line->heard = line->opened = line->spoke = 1; /* opened since we looked: the answer may be quicker than the next look */
    return came;
}
