/* What happens to the bench while it runs: lines `<t_s> what ...`, or `+<t_s> what ...` from the first ENABLE on. */
#ifndef AMB_BENCH_SCRIPT_H
#define AMB_BENCH_SCRIPT_H

#include <stddef.h>
#include <stdint.h>

#define SCRIPT_EVENTS 256
#define SCRIPT_TEXT 96

enum deed {
    DEED_FORCE,     /* number: N from now on */
    DEED_PULSE,     /* number: N, second: s */
    DEED_PULSE_END, /* made by the bench itself; number: N taken back */
    DEED_OVERRIDE,  /* which: sensor, number: V at the pin, NaN: off */
    DEED_INTERLOCK, /* which: 1 open, 0 closed */
    DEED_CABLE,     /* which: 0 mended, 1 cut, 2 cut with the controller's receive line held low */
    DEED_LINE,      /* number: chance that a byte is damaged */
    DEED_LOCKSTEP,  /* number: ms, 0: never wait for the host */
    DEED_END,       /* end the bench */
};

struct event {
    uint64_t tick;
    int after_enable, done;
    enum deed deed;
    int which;
    double number, second;
    char text[SCRIPT_TEXT];
};

struct script {
    struct event event[SCRIPT_EVENTS];
    size_t n;
};

/* Returns 0, or -1 after one line on standard error. */
int script_read(const char *path, struct script *script);

/* The earliest event that is due by `now`, or NULL; `enabled` is the tick of the first ENABLE, or UINT64_MAX. */
struct event *script_due(struct script *script, uint64_t now, uint64_t enabled);

/* Note the end of a pulse. Returns -1 where there is no room. */
int script_add_end_of_pulse(struct script *script, uint64_t tick, double newton);

#endif
