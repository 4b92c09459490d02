/*
 * The parts of the firmware that know no hardware, on the host: one line of standard input is one request, one line of
 * standard output its answer. Built with the address and undefined behaviour sanitizers, so that a defect ends it.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "app.h"
#include "board_fake.h"
#include "commands.h"
#include "control.h"
#include "daq.h"
#include "excitation.h"
#include "frame.h"
#include "safety.h"
#include "tick.h"

static char line[1 << 22];
static uint8_t bytes[1 << 21];

static int digit(char c)
{
    return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : -1;
}

static size_t from_hex(const char *text)
{
    size_t n = 0;
    while (digit(text[0]) >= 0 && digit(text[1]) >= 0) {
        bytes[n++] = (uint8_t)(digit(text[0]) * 16 + digit(text[1]));
        text += 2;
    }
    return n;
}

static void print_hex(const uint8_t *p, size_t n)
{
    while (n--)
        printf("%02x", *p++);
}

/* Empties the transmit ring. */
static void print_sent(void)
{
    while (board_tx.tail != board_tx.head) {
        printf("%02x", board_tx.data[board_tx.tail]);
        board_tx.tail = (uint8_t)((board_tx.tail + 1) & (TX_RING - 1));
    }
}

/* encode HEX: the frame of a body, put at all places of the ring in turn. */
static void encode(const char *rest)
{
    static uint8_t place;
    size_t n = from_hex(rest);
    board_tx.head = board_tx.tail = place++ & (TX_RING - 1);
    if (!frame_put(&board_tx, bytes, (uint8_t)n, 0))
        printf("full");
    print_sent();
    printf("\n");
}

/* feed HEX: bodies of sound frames, `-` for each damaged one. */
static void feed(const char *rest)
{
    static struct decoder decoder;
    size_t i, n = from_hex(rest);
    for (i = 0; i < n; i++) {
        uint8_t found = decoder_feed(&decoder, bytes[i]);
        if (found == FRAME_DAMAGED) {
            printf("- ");
        } else if (found) {
            print_hex(decoder.body, found);
            printf(" ");
        }
    }
    printf("\n");
}

/* law KP KI KD POLE KC SETPOINT REST BIAS: begins anew; says which field is refused, 0 for none. */
static struct control law;
static void begin_law(const char *rest)
{
    long v[8];
    int i;
    char *end = (char *)rest;
    for (i = 0; i < 8; i++)
        v[i] = strtol(end, &end, 10);
    law.gains = (struct msg_gains){1, (int32_t)v[0], (int32_t)v[1], (int32_t)v[2], (uint16_t)v[3],
                                   (int32_t)v[4], (uint16_t)v[5], (uint16_t)v[6], (uint16_t)v[7]};
    law.law = NULL;
    control_reset(&law);
    printf("%d\n", control_refuses(&law.gains));
}

/* words WORD ...: takes over with these words from what ran; 1 if they are refused. */
static void begin_words(const char *rest)
{
    static struct law places[2]; /* one may still run */
    struct law *words = &places[law.law == &places[0]];
    int16_t *word = (int16_t *)(void *)words;
    char *end = (char *)rest;
    memset(words, 0, sizeof *words);
    for (;;) {
        const char *begin = end;
        long w = strtol(begin, &end, 10);
        if (end == begin || word == (int16_t *)(void *)(words + 1))
            break;
        *word++ = (int16_t)w;
    }
    if (law_refuses(words)) {
        printf("1\n");
        return;
    }
    control_take(&law, words);
    printf("0\n");
}

/* gains: the gains of `law` take over again. */
static void back_to_gains(const char *rest)
{
    (void)rest;
    control_take(&law, NULL);
    printf("\n");
}

/* steps LOW HIGH, then position current excitation ...: the pulse widths. */
static void run_law(const char *rest)
{
    char *end;
    uint16_t low = (uint16_t)strtol(rest, &end, 10), high = (uint16_t)strtol(end, &end, 10);
    for (;;) {
        char *begin = end;
        long x = strtol(begin, &end, 10);
        if (end == begin)
            break;
        long i = strtol(end, &end, 10), e = strtol(end, &end, 10);
        control_begin(&law, (uint16_t)x);
        printf("%u ", control_end(&law, (uint16_t)i, (int16_t)e, low, high));
        while (control_ahead(&law))
            ;
    }
    printf("\n");
}

/* play KIND AMPLITUDE HOLD LENGTH CYCLES SEED N: refused field, playing at the end, then N values. */
static void play(const char *rest)
{
    static struct excitation e;
    long v[7];
    int i;
    char *end = (char *)rest;
    for (i = 0; i < 7; i++)
        v[i] = strtol(end, &end, 10);
    struct msg_excitation wanted = {1, (uint8_t)v[0], (uint16_t)v[1], (uint16_t)v[2],
                                    (uint16_t)v[3], (uint16_t)v[4], (uint16_t)v[5]};
    uint8_t field = excitation_refuses(&wanted);
    printf("%d", field);
    if (!field) {
        memset(&e, 0, sizeof e);
        excitation_load(&e, &wanted);
        excitation_begin(&e);
        for (long k = 0; k < v[6]; k++)
            printf(" %d", excitation_next(&e, daq.table));
        printf(" %d", e.playing);
    }
    printf("\n");
}

/* How the controller stands: state cause output duty ready playing ticking rx_errors ticks. */
static void print_stand(void)
{
    printf("%d %d %d %d %d %d %d %d %lu\n", daq.state, daq.cause, fake.output, fake.duty, daq.ready,
           daq.excitation.playing, fake.ticking, daq.rx_errors, (unsigned long)daq.ticks);
}

/* command HEX: the answer to a body, then how the controller stands. */
static void command(const char *rest)
{
    uint8_t answer[ANSWER_LARGEST];
    size_t n = from_hex(rest);
    n = commands_handle(bytes, (uint8_t)n, answer);
    print_hex(answer, n);
    printf(" ");
    print_stand();
}

/* tick A0 A1 A2 LATE: one tick, after a late one if LATE; the sample, then how the controller stands. */
static void one_tick(const char *rest)
{
    char *end = (char *)rest;
    const struct sample *sample;
    int i;
    for (i = 0; i < 3; i++)
        daq.inputs[i] = (uint16_t)strtol(end, &end, 10);
    if (fake.ticking) {
        tick_begin(0);
        if (strtol(end, &end, 10))
            tick_begin(1);
        tick_work();
    }
    sample = tick_sample();
    if (sample) {
        printf("%u:%u", sample->tick, sample->state);
        for (i = 0; i < sample->n; i++)
            printf(":%u", sample->values[i]);
        tick_sent();
    } else {
        printf("-");
    }
    printf(" ");
    print_stand();
}

/* line HEX: bytes on the receive line, one pass of the main loop each 32 of them; what is sent. */
static void on_line(const char *rest)
{
    size_t i, n = from_hex(rest);
    for (i = 0; i < n; i++) {
        if (!rx_put(&board_rx, bytes[i]))
            printf("lost");
        if (i % 32 == 31 || i + 1 == n) {
            uint8_t turns = 40;
            while (turns-- && rx_waiting(&board_rx)) {
                amb_loop();
                print_sent();
            }
        }
    }
    amb_loop();
    print_sent();
    printf(" ");
    print_stand();
}

/* loop: one pass of the main loop; what is sent. */
static void one_loop(const char *rest)
{
    (void)rest;
    amb_loop();
    print_sent();
    printf("\n");
}

static void set(const char *rest)
{
    char name[32];
    int value;
    if (sscanf(rest, "%31s %d", name, &value) != 2)
        exit(3);
    if (!strcmp(name, "interlock"))
        fake.interlock_open = (uint8_t)value;
    else if (!strcmp(name, "line"))
        fake.line_broken = (uint8_t)value;
    else if (!strcmp(name, "pwm"))
        fake.pwm_broken = (uint8_t)value;
    else if (!strcmp(name, "watchdog"))
        fake.by_watchdog = (uint8_t)value;
    else if (!strcmp(name, "current"))
        fake.analog[1] = (uint16_t)value;
    else if (!strcmp(name, "fault"))
        safety_enter((uint8_t)value);
    else
        exit(3);
    print_stand();
}

static void reset(const char *rest)
{
    uint8_t by_watchdog = fake.by_watchdog;
    (void)rest;
    memset(&fake, 0, sizeof fake);
    fake.by_watchdog = by_watchdog;
    fake.supply_mv = 5000;
    fake.free_bytes = 200;
    fake.digest = 0x1234;
    fake.analog[0] = fake.analog[1] = 512;
    board_tx.head = board_tx.tail = 0;
    board_rx.head = board_rx.tail = 0;
    while (tick_sample())
        tick_sent();
    amb_setup();
    print_stand();
}

static const struct {
    const char *name;
    void (*act)(const char *rest);
} verbs[] = {{"encode", encode}, {"feed", feed}, {"law", begin_law},  {"words", begin_words}, {"gains", back_to_gains}, {"steps", run_law},  {"play", play}, {"line", on_line},
             {"command", command}, {"tick", one_tick}, {"set", set}, {"reset", reset}, {"loop", one_loop}};

int main(void)
{
    reset("");
    while (fgets(line, sizeof line, stdin)) {
        size_t i, length = strcspn(line, " \n");
        for (i = 0; i < sizeof verbs / sizeof *verbs; i++)
            if (strlen(verbs[i].name) == length && !strncmp(verbs[i].name, line, length)) {
                verbs[i].act(line + length + (line[length] == ' '));
                break;
            }
        if (i == sizeof verbs / sizeof *verbs) {
            fprintf(stderr, "console: no such request: %.20s\n", line);
            return 2;
        }
    }
    return 0;
}
