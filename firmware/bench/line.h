/* The serial line: a pseudo-terminal towards the host, queues towards the controller; cuts and damage in between. */
#ifndef AMB_BENCH_LINE_H
#define AMB_BENCH_LINE_H

#include <stdint.h>

#include "noise.h"

#define LINE_ROOM 65536u /* bytes, a power of two */

struct queue {
    uint8_t byte[LINE_ROOM];
    uint32_t first, last; /* running numbers of the next byte out and in */
};

enum cable { CABLE_SOUND, CABLE_CUT, CABLE_CUT_LOW };

struct line {
    int terminal;       /* our end */
    char name[128];     /* the host's end */
    int heard;          /* a host has it open */
    int opened;         /* a host had it open at some time */
    int spoke;          /* the host has sent something */
    enum cable cable;
    double damage;      /* chance per byte */
    struct noise noise;
    struct queue to_host, to_controller;
    uint64_t sent, received;     /* bytes that went over the line */
    uint64_t unheard, vanished, damaged; /* to a host that was not there; in a cut cable; with a bit turned */
};

/* Returns 0, or -1 after one line on standard error. */
int line_open(struct line *line, uint64_t seed);
void line_close(struct line *line);

void line_say(struct line *line, uint8_t byte);           /* controller to host */
int line_next(struct line *line);                         /* host to controller: a byte, or -1 */
int line_waiting(const struct line *line);                /* bytes on their way to the controller */
int line_unsent(const struct line *line);                 /* bytes on their way to the host */

/* Move what can be moved at once. Returns the number of bytes that came from the host. */
int line_move(struct line *line);

#endif
