/*
 * The state machine. A command is refused by its shape, then by its state, then by its values; only then is it carried
 * out, whole. One that came before is answered again and not carried out.
 */
#include "commands.h"

#include <stddef.h>
#include <string.h>

#include "daq.h"
#include "flash.h"
#include "frame.h"
#include "report.h"
#include "safety.h"
#include "selftest.h"
#include "states.h"
#include "tick.h"

#define IN(state) (uint8_t)(1 << (state))
#define ANY 0xff
#define OLD 200       /* commands after which one that comes again is a new one; the host repeats within 60 */
#define TABLE_MOST 48 /* elements in one command */

#if LENGTH_STATUS > ANSWER_LARGEST || LENGTH_IDENTITY > ANSWER_LARGEST || LENGTH_SELF_TEST_RESULT > ANSWER_LARGEST
#error "ANSWER_LARGEST is too small"
#endif

struct request {
    const uint8_t *body;
    uint8_t n;
    uint16_t detail;  /* of a refusal */
    uint8_t *answer;
    uint8_t answered; /* length of an own answer, 0: an ack */
};

typedef uint8_t (*handler)(struct request *r);

struct rule {
    uint8_t code, length, states;
    handler handle;
};

static struct {
    uint8_t id, code, age; /* age: commands since */
    uint8_t answer[LENGTH_SELF_TEST_RESULT]; /* the longest that is kept: those of identify and ask_status are not */
} last;

void commands_begin(void)
{
    last.id = 0;
}

static uint8_t out_of_range(struct request *r, uint8_t field)
{
    r->detail = field;
    return CODE_RANGE;
}

static uint8_t not_now(struct request *r)
{
    r->detail = daq.state;
    return CODE_STATE;
}

static uint8_t unready(struct request *r)
{
    r->detail = daq.ready;
    return CODE_UNREADY;
}

static uint8_t on_identify(struct request *r)
{
    r->answered = write_identity(r->answer, r->body[1], PROTOCOL_VERSION, FIRMWARE_MAJOR, FIRMWARE_MINOR, BOARD_KIND,
                                 BOARD_ADC_BITS, BOARD_ANALOG, BOARD_PWM_TOP, BOARD_PWM_HZ, EXCITATION_TABLE,
                                 BOARD_SHORTEST, daq.digest);
    return CODE_DONE;
}

/* Microseconds that a sample takes on the line. */
static uint16_t line_us(uint8_t stream)
{
    uint8_t bytes = FRAME_BYTES(LENGTH_SAMPLE);
    for (; stream; stream >>= 1)
        bytes = (uint8_t)(bytes + ((stream & 1) ? 2 : 0));
    return (uint16_t)(bytes * BOARD_BYTE_US);
}

/* Gains are per tick: another period makes them wrong, so they must come again. */
static uint8_t on_configure(struct request *r)
{
    struct msg_configure wanted = read_configure(r->body);
    if (wanted.stream == 0 || (wanted.stream & ~STREAM_ALL))
        return out_of_range(r, 3);
    if (wanted.period < BOARD_SHORTEST || wanted.period > BOARD_LONGEST ||
        line_us(wanted.stream) > (uint32_t)wanted.period * BOARD_PERIOD_US)
        return out_of_range(r, 2);
    if (wanted.period != daq.period)
        daq.ready &= (uint8_t)~READY_GAINS;
    daq.period = wanted.period;
    daq.stream = wanted.stream;
    daq.ready |= READY_CONFIGURE;
    return CODE_DONE;
}

/* Both ends within [least, most], the upper one above the lower: 0; else 1 for the lower end, 2 for the upper. */
static uint8_t interval_refuses(uint16_t low, uint16_t high, uint16_t least, uint16_t most)
{
    if (low < least)
        return 1;
    return high > most || high <= low ? 2 : 0;
}

/* The whole range of the converter: there is no position, as where only a coil is driven. */
static uint8_t position_unused(const struct msg_limits *l)
{
    return l->position_low == 0 && l->position_high == BOARD_ADC_TOP;
}

/* An input never leaves an interval that ends where the converter does. Only a current sensor that shows one sign has one
 * such end, and needs the other. */
static uint8_t limits_refuse(const struct msg_limits *l)
{
    uint8_t end;
    if (!position_unused(l) && (end = interval_refuses(l->position_low, l->position_high, 1, BOARD_ADC_TOP - 1)) != 0)
        return (uint8_t)(1 + end);
    if ((end = interval_refuses(l->current_low, l->current_high, CAP_CURRENT_LOW, CAP_CURRENT_HIGH)) != 0)
        return (uint8_t)(3 + end);
    if (l->current_low == 0 && l->current_high == BOARD_ADC_TOP)
        return 5;
    if ((end = interval_refuses(l->duty_low, l->duty_high, CAP_DUTY_LOW, CAP_DUTY_HIGH)) != 0)
        return (uint8_t)(5 + end);
    if (l->duty_off > CAP_DUTY_HIGH)
        return 8;
    if (l->host_ms < HOST_MS_LEAST || l->host_ms > HOST_MS_MOST)
        return 9;
    if (l->lift_ms > LIFT_MS_MOST)
        return 10;
    return 0;
}

static uint8_t on_limits(struct request *r)
{
    struct msg_limits wanted = read_limits(r->body);
    uint8_t field = limits_refuse(&wanted);
    if (field)
        return out_of_range(r, field);
    ATOMICALLY
    {
        daq.limits = wanted;
        board_duty(wanted.duty_off); /* the output is off in the states in which limits are taken */
    }
    daq.ready |= READY_LIMITS;
    return CODE_DONE;
}

static uint8_t position_outside(uint16_t position)
{
    if (!(daq.ready & READY_LIMITS))
        return position > BOARD_ADC_TOP;
    return position < daq.limits.position_low || position > daq.limits.position_high;
}

static uint8_t duty_outside(uint16_t duty)
{
    if (!(daq.ready & READY_LIMITS))
        return duty > BOARD_PWM_TOP;
    return duty < daq.limits.duty_low || duty > daq.limits.duty_high;
}

static uint8_t on_gains(struct request *r)
{
    struct msg_gains wanted = read_gains(r->body);
    uint8_t field = control_refuses(&wanted);
    if (daq.state == STATE_LEVITATING && (daq.control.law || daq.trial.on))
        return not_now(r);
    if (field)
        return out_of_range(r, field);
    if (position_outside(wanted.setpoint))
        return out_of_range(r, 7);
    if (wanted.current_rest > BOARD_ADC_TOP)
        return out_of_range(r, 8);
    if (duty_outside(wanted.duty_bias))
        return out_of_range(r, 9);
    ATOMICALLY { daq.control.gains = wanted; }
    daq.control.law = NULL; /* idle or sampling */
    daq.ready |= READY_GAINS;
    return CODE_DONE;
}

static uint8_t on_law(struct request *r)
{
    uint8_t field;
    if (daq.trial.on || daq.excitation.playing)
        return not_now(r);
    field = trial_stage(read_law(r->body, r->n).offset, r->body + LENGTH_LAW, read_law(r->body, r->n).n_words);
    return field ? out_of_range(r, field) : CODE_DONE;
}

static uint8_t on_arm(struct request *r)
{
    struct msg_arm wanted = read_arm(r->body);
    uint8_t field;
    if (!(daq.ready & READY_GAINS))
        return unready(r);
    if (daq.trial.on)
        return not_now(r);
    field = trial_arm(&wanted);
    return field ? out_of_range(r, field) : CODE_DONE;
}

static uint8_t on_settle(struct request *r)
{
    uint8_t keep = read_settle(r->body).keep;
    if (daq.trial.on != TRIAL_RUNS)
        return not_now(r);
    if (keep > 1)
        return out_of_range(r, 2);
    if (keep)
        return trial_confirm() ? CODE_DONE : not_now(r);
    daq.trial.asked = 1; /* the tick does it */
    return CODE_DONE;
}

static uint8_t on_ask_law(struct request *r)
{
    r->answered = report_law(r->answer, r->body[1]);
    return CODE_DONE;
}

static uint8_t on_setpoint(struct request *r)
{
    struct msg_setpoint wanted = read_setpoint(r->body);
    if (!(daq.ready & READY_GAINS))
        return unready(r);
    if (position_outside(wanted.setpoint))
        return out_of_range(r, 2);
    ATOMICALLY { daq.control.gains.setpoint = wanted.setpoint; }
    return CODE_DONE;
}

static uint8_t on_excitation(struct request *r)
{
    struct msg_excitation wanted = read_excitation(r->body);
    uint8_t field = excitation_refuses(&wanted);
    if (daq.excitation.playing)
        return not_now(r);
    if (wanted.kind == KIND_TABLE && wanted.length > trial_table())
        field = 5;
    if (field)
        return out_of_range(r, field);
    excitation_load(&daq.excitation, &wanted);
    return CODE_DONE;
}

static uint8_t on_table(struct request *r)
{
    struct msg_table wanted = read_table(r->body, r->n);
    uint8_t i;
    if (daq.excitation.playing)
        return not_now(r);
    if (wanted.n_values == 0 || wanted.n_values > TABLE_MOST)
        return out_of_range(r, 3);
    if (wanted.offset > (uint16_t)(trial_table() - wanted.n_values))
        return out_of_range(r, 2);
    for (i = 0; i < wanted.n_values; i++)
        if (table_values(r->body, i) == -128)
            return out_of_range(r, 3);
    for (i = 0; i < wanted.n_values; i++)
        daq.table[wanted.offset + i] = table_values(r->body, i);
    return CODE_DONE;
}

static uint8_t on_excite(struct request *r)
{
    struct msg_excite wanted = read_excite(r->body);
    if (wanted.on > 1)
        return out_of_range(r, 2);
    ATOMICALLY
    {
        daq.excitation.playing = 0;
        if (wanted.on && daq_output_on()) /* a fault may just have come */
            excitation_begin(&daq.excitation);
        tick_prepare();
    }
    return CODE_DONE;
}

static uint8_t on_start(struct request *r)
{
    uint8_t mode = read_start(r->body).mode, needs = READY_CONFIGURE;
    if (mode < MODE_SAMPLE || mode > MODE_LEVITATE)
        return out_of_range(r, 2);
    if (mode == MODE_SAMPLE && daq.state != STATE_IDLE)
        return not_now(r);
    if (mode != MODE_SAMPLE)
        needs |= READY_LIMITS;
    if (mode == MODE_LEVITATE)
        needs |= READY_GAINS;
    if ((daq.ready & needs) != needs)
        return unready(r);
    if (mode != MODE_SAMPLE) {
        if (daq.period < CAP_OUTPUT_FASTEST || daq.period > CAP_OUTPUT_PERIOD)
            return out_of_range(r, 2);
        if (mode == MODE_LEVITATE && (position_outside(daq.control.gains.setpoint) || duty_outside(daq.control.gains.duty_bias)))
            return out_of_range(r, 2); /* limits that came after the gains leave these out */
        if (mode == MODE_LEVITATE && position_unused(&daq.limits))
            return out_of_range(r, 2);
        if (board_interlock_open())
            return CODE_INTERLOCK;
    }
    if (daq.state == STATE_IDLE)
        daq_start();
    if (mode != MODE_SAMPLE)
        daq_output(mode == MODE_DRIVE ? STATE_DRIVING : STATE_LEVITATING);
    return CODE_DONE;
}

static uint8_t on_stop(struct request *r)
{
    (void)r;
    daq_stop();
    return CODE_DONE;
}

static uint8_t on_clear(struct request *r)
{
    uint8_t code = safety_clears();
    if (code != CODE_DONE) {
        r->detail = daq.state;
        return code;
    }
    daq_stop();
    ATOMICALLY
    {
        daq.state = STATE_IDLE;
        daq.cause = CAUSE_NONE;
    }
    return CODE_DONE;
}

static uint8_t on_ping(struct request *r)
{
    (void)r;
    return CODE_DONE;
}

static uint8_t on_ask_status(struct request *r)
{
    r->answered = report_status(r->answer, r->body[1]);
    return CODE_DONE;
}

static uint8_t on_self_test(struct request *r)
{
    struct msg_self_test_result result;
    selftest_run(&result);
    if (result.failed & (FAILED_PROGRAM | FAILED_MEMORY | FAILED_PULSE_WIDTH))
        safety_enter(CAUSE_SELF_TEST);
    r->answered = write_self_test_result(r->answer, r->body[1], result.failed, result.supply_mv, result.free_bytes,
                                         result.position, result.current);
    return CODE_DONE;
}

static const struct rule rules[] FLASH = {
    {MSG_IDENTIFY, LENGTH_IDENTIFY, ANY, on_identify},
    {MSG_CONFIGURE, LENGTH_CONFIGURE, IN(STATE_IDLE), on_configure},
    {MSG_LIMITS, LENGTH_LIMITS, IN(STATE_IDLE) | IN(STATE_SAMPLING) | IN(STATE_FAULT), on_limits},
    {MSG_GAINS, LENGTH_GAINS, IN(STATE_IDLE) | IN(STATE_SAMPLING) | IN(STATE_LEVITATING), on_gains},
    {MSG_SETPOINT, LENGTH_SETPOINT, IN(STATE_IDLE) | IN(STATE_SAMPLING) | IN(STATE_LEVITATING), on_setpoint},
    {MSG_EXCITATION, LENGTH_EXCITATION, ANY, on_excitation},
    {MSG_TABLE, LENGTH_TABLE, ANY, on_table},
    {MSG_EXCITE, LENGTH_EXCITE, IN(STATE_DRIVING) | IN(STATE_LEVITATING), on_excite},
    {MSG_START, LENGTH_START, IN(STATE_IDLE) | IN(STATE_SAMPLING), on_start},
    {MSG_STOP, LENGTH_STOP, ANY, on_stop},
    {MSG_CLEAR, LENGTH_CLEAR, IN(STATE_FAULT), on_clear},
    {MSG_PING, LENGTH_PING, ANY, on_ping},
    {MSG_ASK_STATUS, LENGTH_ASK_STATUS, ANY, on_ask_status},
    {MSG_SELF_TEST, LENGTH_SELF_TEST, IN(STATE_IDLE), on_self_test},
    {MSG_LAW, LENGTH_LAW, IN(STATE_IDLE) | IN(STATE_SAMPLING) | IN(STATE_LEVITATING), on_law},
    {MSG_ARM, LENGTH_ARM, IN(STATE_IDLE) | IN(STATE_SAMPLING) | IN(STATE_LEVITATING), on_arm},
    {MSG_SETTLE, LENGTH_SETTLE, IN(STATE_LEVITATING), on_settle},
    {MSG_ASK_LAW, LENGTH_ASK_LAW, ANY, on_ask_law},
};

static uint8_t rule_of(uint8_t code, struct rule *rule)
{
    uint8_t i;
    for (i = 0; i < sizeof rules / sizeof *rules; i++) {
        flash_copy(rule, &rules[i], sizeof *rule);
        if (rule->code == code)
            return 1;
    }
    return 0;
}

/* The length must be the message's own; those of a table and of a law vary. */
static uint8_t fits(const struct rule *rule, uint8_t n)
{
    if (rule->code == MSG_LAW)
        return n >= rule->length && !((n - rule->length) & 1);
    return rule->code == MSG_TABLE ? n >= rule->length : n == rule->length;
}

/* A message to the host is no command, but an echo on the line: an answer to it would come back too. */
static uint8_t malformed(const uint8_t *body, uint8_t n, uint8_t *answer, uint8_t code)
{
    daq_count(&daq.rx_errors);
    if (body[0] < MSG_IDENTIFY)
        return 0;
    return write_ack(answer, n < 2 ? 0 : body[1], code, 0);
}

uint8_t commands_handle(const uint8_t *body, uint8_t n, uint8_t *answer)
{
    struct rule rule;
    struct request r = {body, n, 0, answer, 0};
    uint8_t code = body[0], id = body[1], done; /* body is gone once there is an answer */
    if (!rule_of(code, &rule))
        return malformed(body, n, answer, CODE_UNKNOWN);
    if (!fits(&rule, n))
        return malformed(body, n, answer, CODE_LENGTH);
    ATOMICALLY { daq.silent_ticks = 0; } /* this is the host, and not noise or an echo */
    if (id == 0)
        return write_ack(answer, 0, CODE_RANGE, 1);
    if (id == last.id && code == last.code) {
        uint8_t length = last.answer[0] == MSG_ACK ? LENGTH_ACK : LENGTH_SELF_TEST_RESULT;
        memcpy(answer, last.answer, length);
        return length;
    }
    if (++last.age == OLD)
        last.id = 0; /* before numbers come round to it */
    done = (rule.states & IN(daq.state)) ? rule.handle(&r) : not_now(&r);
    if (!r.answered)
        r.answered = write_ack(answer, id, done, r.detail);
    if (code == MSG_IDENTIFY) {
        last.id = 0;
    } else if (code != MSG_PING && code != MSG_ASK_STATUS && code != MSG_ASK_LAW) {
        last.id = id;
        last.code = code;
        last.age = 0;
        memcpy(last.answer, answer, r.answered);
    }
    return r.answered;
}
