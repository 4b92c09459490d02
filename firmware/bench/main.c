/* amb_bench: the firmware's own binary in an emulated controller, in a loop with a simulated magnetic bearing, behind a
 * pseudo-terminal that an ordinary serial driver opens. See README.md. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include "controller.h"
#include "journal.h"
#include "script.h"

#define TICKS_PER_MS 16000u
#define ROUND 2000u    /* ticks between two looks at the line: 125 us */
#define UNSENT 1024    /* bytes to a slow host for which emulated time waits */
#define CATCH_UP_NS 500000000 /* what a bench at real pace makes up for after a stall */

struct options {
    const char *firmware, *plant, *log, *trajectory, *script, *link;
    int real;
    double lockstep_ms;
    uint64_t seed;
};

static struct plant plant;
static struct line line;
static struct controller controller;
static struct script script;
static int bell[2]; /* rung by a signal: ends every wait */
static volatile sig_atomic_t ended;
static pid_t parent;

/* ---- ending and waiting ---------------------------------------------------------------------------------------- */

static void ring(int signal)
{
    const int kept = errno;
    /* The parent's death is told by SIGUSR1, but so is that of the parent's thread that started us. */
    if (signal != SIGUSR1)
        ended = 1;
    if (write(bell[1], "", 1) < 0) {
        /* full: it rings already */
    }
    errno = kept;
}

static int listen_for_signals(void)
{
    struct sigaction what = {.sa_handler = ring};
    if (pipe2(bell, O_CLOEXEC | O_NONBLOCK) != 0) {
        fprintf(stderr, "amb_bench: no pipe: %s\n", strerror(errno));
        return -1;
    }
    sigaction(SIGTERM, &what, NULL);
    sigaction(SIGINT, &what, NULL);
    sigaction(SIGHUP, &what, NULL);
    sigaction(SIGUSR1, &what, NULL);
    signal(SIGPIPE, SIG_IGN);
    parent = getppid();
    prctl(PR_SET_PDEATHSIG, SIGUSR1);
    return 0;
}

static int over(void)
{
    if (getppid() != parent)
        ended = 1;
    return ended;
}

/* Wait for the line (`events`), a signal, or the end of `ms`. */
static void rest(short events, int ms)
{
    char used[16];
    struct pollfd what[2] = {{.fd = bell[0], .events = POLLIN}, {.fd = line.terminal, .events = events}};
    /* A line that nobody has open is always ready with its hang-up: look again a little later. */
    const int watched = line.heard && events ? 2 : 1;
    poll(what, (nfds_t)watched, line.heard ? ms : ms < 5 ? ms : 5);
    while (read(bell[0], used, sizeof used) > 0) {
    }
}

/* ---- pace ------------------------------------------------------------------------------------------------------ */

static int64_t nanoseconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static uint64_t heard_at;

static void listen_to_line(void)
{
    if (line_move(&line) > 0)
        heard_at = controller.avr->cycle;
}

/* Emulated time stands until the host has taken what it was sent; until there is one at all; and, once it spoke, until it
 * has spoken again. */
static void wait_for_host(const struct options *o)
{
    const uint64_t patience = (uint64_t)(o->lockstep_ms * TICKS_PER_MS);
    while (!over() && line.heard && line_unsent(&line) > UNSENT) {
        rest(POLLOUT | POLLIN, 100);
        listen_to_line();
    }
    while (!over() && patience > 0 && (line.spoke || !line.opened) && controller.avr->cycle - heard_at > patience) {
        rest(POLLIN, 100);
        listen_to_line();
    }
}

static void keep_pace(void)
{
    static int64_t origin;
    static uint64_t origin_tick;
    const uint64_t tick = controller.avr->cycle;
    int64_t ahead = 0;
    while (!over()) {
        const int64_t wall = nanoseconds();
        if (origin == 0 || ahead < -CATCH_UP_NS) {
            origin = wall;
            origin_tick = tick;
        }
        ahead = (int64_t)((double)(tick - origin_tick) * 62.5) - (wall - origin);
        if (ahead < -CATCH_UP_NS)
            continue;
        if (ahead < 1000000)
            return;
        rest(POLLIN, (int)(ahead / 1000000));
        listen_to_line();
    }
}

/* ---- script ---------------------------------------------------------------------------------------------------- */

/* `e` is a copy: the end of a pulse may take its place. */
static void carry_out(const struct event *e, struct options *o)
{
    controller_carry(&controller);
    switch (e->deed) {
    case DEED_FORCE:
        plant.push = e->number;
        break;
    case DEED_PULSE:
        plant.push += e->number;
        if (script_add_end_of_pulse(&script, controller.at + (uint64_t)(e->second * PLANT_TICK_HZ), e->number) != 0)
            fprintf(stderr, "amb_bench: no room for the end of a pulse; it stays\n");
        break;
    case DEED_PULSE_END:
        plant.push -= e->number;
        break;
    case DEED_OVERRIDE:
        controller.override[e->which] = e->number;
        break;
    case DEED_INTERLOCK:
        controller.interlock_open = e->which;
        controller_wire(&controller);
        break;
    case DEED_CABLE:
        line.cable = (enum cable)e->which;
        controller_wire(&controller);
        if (line.cable == CABLE_CUT_LOW)
            controller_break(&controller);
        break;
    case DEED_LINE:
        line.damage = e->number;
        break;
    case DEED_LOCKSTEP:
        o->lockstep_ms = e->number;
        break;
    case DEED_END:
        ended = 1;
        break;
    }
    journal_write(controller_seconds(&controller), "script", "\"text\": \"%s\"", journal_quoted(e->text));
}

static void follow_script(struct options *o)
{
    struct event *due;
    while ((due = script_due(&script, controller.avr->cycle, controller.first_enable)) != NULL) {
        const struct event now = *due;
        due->done = 1;
        carry_out(&now, o);
    }
}

/* ---- the run --------------------------------------------------------------------------------------------------- */

static void look_around(struct options *o)
{
    static int there;
    static unsigned rounds;
    if (rounds++ % 256 == 0 && over())
        return;
    listen_to_line();
    if (line.heard != there) {
        there = line.heard;
        journal_write(controller_seconds(&controller), "host", "\"open\": %d", there);
    }
    wait_for_host(o);
    if (o->real)
        keep_pace();
    uart_feed(&controller);
}

static const char *run(struct options *o)
{
    uint64_t next = 0;
    while (!ended) {
        const int state = controller_run(&controller);
        if (state == cpu_Done || state == cpu_Crashed)
            return state == cpu_Done ? "halted" : "crashed";
        if (script.n > 0)
            follow_script(o);
        if (controller.avr->cycle >= next) {
            next = controller.avr->cycle + ROUND;
            look_around(o);
        }
    }
    return "asked";
}

static void usage(FILE *to)
{
    fputs("usage: amb_bench --firmware ELF --plant FILE [--pace real|fastest] [--lockstep MS] [--log FILE.jsonl]\n"
          "                 [--trajectory FILE.csv] [--script FILE] [--seed N] [--link PATH]\n",
          to);
}

static int read_options(int argc, char **argv, struct options *o)
{
    static const struct option known[] = {
        {"firmware", required_argument, NULL, 'f'}, {"plant", required_argument, NULL, 'p'},
        {"pace", required_argument, NULL, 'a'},     {"lockstep", required_argument, NULL, 'l'},
        {"log", required_argument, NULL, 'g'},      {"trajectory", required_argument, NULL, 't'},
        {"script", required_argument, NULL, 's'},   {"seed", required_argument, NULL, 'n'},
        {"link", required_argument, NULL, 'k'},     {"help", no_argument, NULL, 'h'},
        {NULL, 0, NULL, 0},
    };
    char *end = NULL;
    int bad = 0;
    memset(o, 0, sizeof *o);
    o->lockstep_ms = 100.0;
    for (int c; (c = getopt_long(argc, argv, "", known, NULL)) != -1;) {
        switch (c) {
        case 'f': o->firmware = optarg; break;
        case 'p': o->plant = optarg; break;
        case 'g': o->log = optarg; break;
        case 't': o->trajectory = optarg; break;
        case 's': o->script = optarg; break;
        case 'k': o->link = optarg; break;
        case 'a':
            o->real = strcmp(optarg, "real") == 0;
            bad |= !o->real && strcmp(optarg, "fastest") != 0;
            break;
        case 'l':
            o->lockstep_ms = strtod(optarg, &end);
            bad |= end == optarg || *end != '\0' || !(o->lockstep_ms >= 0.0 && o->lockstep_ms < 1e9);
            break;
        case 'n':
            o->seed = strtoull(optarg, &end, 10);
            bad |= end == optarg || *end != '\0';
            break;
        case 'h':
            usage(stdout);
            exit(0);
        default:
            bad = 1;
        }
    }
    if (bad || optind != argc || o->firmware == NULL || o->plant == NULL) {
        usage(stderr);
        return -1;
    }
    return 0;
}

static int make_link(const struct options *o)
{
    if (o->link != NULL && (unlink(o->link) != 0 && errno != ENOENT)) {
        fprintf(stderr, "amb_bench: --link %s: %s\n", o->link, strerror(errno));
        return -1;
    }
    if (o->link != NULL && symlink(line.name, o->link) != 0) {
        fprintf(stderr, "amb_bench: --link %s: %s\n", o->link, strerror(errno));
        return -1;
    }
    return 0;
}

static int open_files(const struct options *o)
{
    if (journal_open(o->log) != 0)
        return -1;
    if (o->trajectory != NULL) {
        controller.trajectory = fopen(o->trajectory, "w");
        if (controller.trajectory == NULL) {
            fprintf(stderr, "amb_bench: --trajectory %s: %s\n", o->trajectory, strerror(errno));
            return -1;
        }
        fputs("t,x,v,i,voltage,duty,begin,current_0,current_1\n", controller.trajectory);
    }
    return 0;
}

int main(int argc, char **argv)
{
    struct options o;
    struct plant_config config;
    if (read_options(argc, argv, &o) != 0 || plant_read(o.plant, &config, stderr) != 0 ||
        script_read(o.script, &script) != 0)
        return 2;
    /* Whatever the emulator's library prints goes to standard error; standard output is for the one line. */
    const int out = dup(STDOUT_FILENO);
    dup2(STDERR_FILENO, STDOUT_FILENO);
    plant_begin(&plant, &config, o.seed);
    if (listen_for_signals() != 0 || line_open(&line, o.seed ^ UINT64_C(0x6c696e65)) != 0 ||
        controller_begin(&controller, o.firmware, &plant, &line) != 0 || open_files(&o) != 0 || make_link(&o) != 0)
        return 2;
    journal_write(0.0, "start", "\"firmware\": \"%s\", \"seed\": %llu, \"position\": %.9g", journal_quoted(o.firmware),
                  (unsigned long long)o.seed, plant.x);
    dprintf(out, "{\"pty\": \"%s\"}\n", line.name);
    close(out);
    const int64_t began = nanoseconds();
    const char *reason = run(&o);
    journal_write(controller_seconds(&controller), "end",
                  "\"reason\": \"%s\", \"wall_s\": %.3f, \"to_host\": %llu, \"to_controller\": %llu, \"unheard\": %llu,"
                  " \"vanished\": %llu, \"damaged\": %llu, \"late\": %llu, \"conversions\": %llu, \"resets\": %llu",
                  reason, (double)(nanoseconds() - began) * 1e-9, (unsigned long long)line.sent,
                  (unsigned long long)line.received, (unsigned long long)line.unheard,
                  (unsigned long long)line.vanished, (unsigned long long)line.damaged,
                  (unsigned long long)controller.late, (unsigned long long)controller.conversions,
                  (unsigned long long)controller.resets);
    if (controller.trajectory != NULL)
        fclose(controller.trajectory);
    if (o.link != NULL)
        unlink(o.link);
    journal_close();
    line_close(&line);
    if (strcmp(reason, "crashed") == 0)
        fprintf(stderr, "amb_bench: the firmware crashed after %.6f s\n", controller_seconds(&controller));
    return strcmp(reason, "asked") == 0 ? 0 : 3;
}
