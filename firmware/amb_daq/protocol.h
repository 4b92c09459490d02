/*
 * The wire protocol, version 1: made by tools/protocol_header.py
 * from src/ambid/acquisition/protocol/messages.toml. Change the table, not this file.
 *
 * A frame is COBS( code | fields, little endian | CRC-16/XMODEM, low byte first ) 0x00.
 * read_NAME(p) takes the bytes from the code on, already found sound and long enough (LENGTH_NAME); write_NAME(p, ...)
 * puts code and fields at p and returns how many bytes these are. Neither knows of the CRC.
 * A message that ends in an array: LENGTH_NAME counts none of its elements; read_NAME(p, length) says how many there
 * are, and NAME_FIELD(p, i) gives the one with index i.
 */
#ifndef AMB_DAQ_PROTOCOL_H
#define AMB_DAQ_PROTOCOL_H

#include <stdint.h>

#define PROTOCOL_VERSION 1
#define PROTOCOL_BAUD 1000000UL
#define FRAME_LARGEST 64 /* bytes of code, fields and CRC */

#define MSG_SAMPLE 0x01 /* to the host: one tick */
#define MSG_ACK 0x02 /* to the host: answer to every command that has no answer of its own, and to every refused one */
#define MSG_IDENTITY 0x03 /* to the host: answer to identify */
#define MSG_STATUS 0x04 /* to the host: answer to ask_status; with id 0 unasked, every 256 ticks */
#define MSG_SELF_TEST_RESULT 0x05 /* to the host: answer to self_test */
#define MSG_FAULT 0x06 /* to the host: sent once, at once, when the safe state is entered */
#define MSG_LAW_STATUS 0x07 /* to the host: answer to ask_law; with id 0 unasked, when the controller returned to the law before the one on trial */
#define MSG_IDENTIFY 0x10 /* to the controller: who are you; any state; the number of the last command is forgotten */
#define MSG_CONFIGURE 0x11 /* to the controller: sampling; idle only; refused where a sample would not fit into the period at 11 us a byte; a new period makes gains invalid */
#define MSG_LIMITS 0x12 /* to the controller: what the controller holds to, whatever else it is told; idle, sampling or fault. An end of a trip at an end of the converter would never trip: refused, but for one end of the current (a sensor of one sign), and for 0 to 1023 of the position, which says that there is none (no levitation then) */
#define MSG_GAINS 0x13 /* to the controller: position loop; idle, sampling or levitating (changed between two ticks), not while a state-space law runs there; it takes the place of such a law; gains are within +-2^19. A change of duty_bias, kp or kc while levitating is not bumpless: the integral is kept, the pulse width jumps. See firmware/amb_daq/control.h */
#define MSG_SETPOINT 0x14 /* to the controller: set point of the position; idle, sampling or levitating; within limits */
#define MSG_EXCITATION 0x15 /* to the controller: what is added to the pulse width once excite says so; not while it plays */
#define MSG_TABLE 0x16 /* to the controller: elements of the excitation table; not while it plays */
#define MSG_EXCITE 0x17 /* to the controller: begin (1) at the next tick, from its first element also while it plays, or end (0) the excitation; driving or levitating */
#define MSG_START 0x18 /* to the controller: begin: ticks count from 0; from idle, or from sampling to drive or levitate (ticks count on); the output goes on with the tick after the first one whose checks are passed, when the pulse width that this one ordered acts */
#define MSG_STOP 0x19 /* to the controller: output off and idle; any state but fault, from which only samples stop */
#define MSG_CLEAR 0x1a /* to the controller: leave the safe state to idle; fault only, and only if its cause is gone; out_of_gap, host_silent and overrun always are */
#define MSG_PING 0x1b /* to the controller: the host is there; any state */
#define MSG_ASK_STATUS 0x1c /* to the controller: answered by status; any state */
#define MSG_SELF_TEST 0x1d /* to the controller: answered by self_test_result; idle only */
#define MSG_LAW 0x1e /* to the controller: words of a state-space law that is to be armed; idle, sampling or levitating, not on trial, not while an excitation plays; a loaded excitation by the table is forgotten, as words and the table's last elements share memory. See firmware/amb_daq/law.h */
#define MSG_ARM 0x1f /* to the controller: the words are whole: run them instead of gains or law, after gains. Idle or sampling: from the next start. Levitating: from the next tick, on trial; what ran before returns where the rotor leaves the bounds, or without settle in time. Detail 1 of range: words that could overflow */
#define MSG_SETTLE 0x20 /* to the controller: end of the trial; levitating, on trial */
#define MSG_ASK_LAW 0x21 /* to the controller: answered by law_status; any state */

#define LENGTH_SAMPLE 4
#define LENGTH_ACK 5
#define LENGTH_IDENTITY 20
#define LENGTH_STATUS 24
#define LENGTH_SELF_TEST_RESULT 12
#define LENGTH_FAULT 10
#define LENGTH_LAW_STATUS 11
#define LENGTH_IDENTIFY 2
#define LENGTH_CONFIGURE 5
#define LENGTH_LIMITS 20
#define LENGTH_GAINS 26
#define LENGTH_SETPOINT 4
#define LENGTH_EXCITATION 13
#define LENGTH_TABLE 4
#define LENGTH_EXCITE 3
#define LENGTH_START 3
#define LENGTH_STOP 2
#define LENGTH_CLEAR 2
#define LENGTH_PING 2
#define LENGTH_ASK_STATUS 2
#define LENGTH_SELF_TEST 2
#define LENGTH_LAW 3
#define LENGTH_ARM 12
#define LENGTH_SETTLE 3
#define LENGTH_ASK_LAW 2

#define STATE_IDLE 0 /* output off, no samples */
#define STATE_SAMPLING 1 /* output off, samples flow */
#define STATE_DRIVING 2 /* output on, duty = bias + excitation, no feedback */
#define STATE_LEVITATING 3 /* output on, position loop closed on the controller */
#define STATE_FAULT 4 /* safe state: output off until cleared; samples flow on */

#define CAUSE_NONE 0 /* no fault since the last clear */
#define CAUSE_OVERRUN 1 /* a tick came before the work of the last one was done */
#define CAUSE_HOST_SILENT 2 /* no sound command from the host for longer than limits.host_ms */
#define CAUSE_OVER_CURRENT 3 /* current outside limits */
#define CAUSE_OUT_OF_GAP 4 /* position outside limits */
#define CAUSE_INTERLOCK 5 /* the interlock loop is open: cable pulled or emergency stop */
#define CAUSE_LINE_BREAK 6 /* the receive line is held low, or bytes without stop bit: cable cut */
#define CAUSE_SELF_TEST 7 /* the self-test failed */
#define CAUSE_WATCHDOG 8 /* the program hung and was restarted; told in state idle, until the next fault */

#define CODE_DONE 0 /* carried out */
#define CODE_UNKNOWN 1 /* no such command */
#define CODE_LENGTH 2 /* wrong number of bytes */
#define CODE_RANGE 3 /* a value is outside what the controller allows; detail: number of the field, from 1 */
#define CODE_STATE 4 /* not in this state; detail: the state */
#define CODE_UNREADY 5 /* configure, limits or gains are still to be given; detail: bits ready */
#define CODE_INTERLOCK 6 /* the interlock loop is open */

#define MODE_SAMPLE 1 /* samples only */
#define MODE_DRIVE 2 /* excitation without feedback */
#define MODE_LEVITATE 3 /* position loop */

#define KIND_NONE 0 /* no excitation */
#define KIND_STEP 1 /* square wave: +amplitude for `hold` ticks, -amplitude for `hold` ticks */
#define KIND_PRBS 2 /* maximum length sequence of a shift register of `length` bits, one bit each `hold` ticks */
#define KIND_TABLE 3 /* `length` elements of the table, one each `hold` ticks; element 127 is the amplitude */

#define RUNS_GAINS 0 /* the position loop of message gains */
#define RUNS_LAW 1 /* a state-space law */

#define BACK_OUT_NONE 0 /* none since the last arm */
#define BACK_OUT_BOUNDS 1 /* the rotor left the bounds of the trial */
#define BACK_OUT_UNCONFIRMED 2 /* the host did not confirm in time */
#define BACK_OUT_ASKED 3 /* the host asked for it */
#define BACK_OUT_ENDED 4 /* the output went off during the trial */

#define FAILED_PROGRAM 0x01 /* the program memory does not have the digest that it had at reset */
#define FAILED_SUPPLY 0x02 /* supply voltage outside 4.5 to 5.5 V */
#define FAILED_POSITION 0x04 /* position input at an end of its range */
#define FAILED_CURRENT 0x08 /* current input, output off: not still within 32 counts, or outside limits where these are known */
#define FAILED_INTERLOCK 0x10 /* the interlock loop is open */
#define FAILED_MEMORY 0x20 /* the stack came within 48 bytes of its end, or memory does not hold what is written */
#define FAILED_PULSE_WIDTH 0x40 /* the pulse width modulation does not run as set */

#define READY_CONFIGURE 0x01 /* configure was given */
#define READY_LIMITS 0x02 /* limits were given */
#define READY_GAINS 0x04 /* gains were given */

#define STREAM_ANALOG_0 0x01 /* u16: position input, counts */
#define STREAM_ANALOG_1 0x02 /* u16: current input, counts */
#define STREAM_ANALOG_2 0x04 /* u16: third input, counts */
#define STREAM_DUTY 0x08 /* u16: pulse width ordered at this tick, counts */
#define STREAM_EXCITATION 0x10 /* i16: excitation in it, counts of pulse width */
#define STREAM_SETPOINT 0x20 /* u16: set point of the position, counts */

#define STREAM_ALL 0x3f
#define STREAM_COLUMNS 6

static inline uint8_t get_u8(const uint8_t *p) { return p[0]; }
static inline uint16_t get_u16(const uint8_t *p) { return (uint16_t)(p[0] | (uint16_t)((uint16_t)p[1] << 8)); }
static inline uint32_t get_u32(const uint8_t *p) { return get_u16(p) | ((uint32_t)get_u16(p + 2) << 16); }
static inline int8_t get_i8(const uint8_t *p) { return (int8_t)get_u8(p); }
static inline int16_t get_i16(const uint8_t *p) { return (int16_t)get_u16(p); }
static inline int32_t get_i32(const uint8_t *p) { return (int32_t)get_u32(p); }

static inline void put_u8(uint8_t *p, uint8_t v) { p[0] = v; }
static inline void put_u16(uint8_t *p, uint16_t v) { p[0] = (uint8_t)v; p[1] = (uint8_t)(v >> 8); }
static inline void put_u32(uint8_t *p, uint32_t v) { put_u16(p, (uint16_t)v); put_u16(p + 2, (uint16_t)(v >> 16)); }
static inline void put_i8(uint8_t *p, int8_t v) { put_u8(p, (uint8_t)v); }
static inline void put_i16(uint8_t *p, int16_t v) { put_u16(p, (uint16_t)v); }
static inline void put_i32(uint8_t *p, int32_t v) { put_u32(p, (uint32_t)v); }

/* sample: one tick */
struct msg_sample {
    uint16_t tick; /* number of the tick since start, modulo 65536 */
    uint8_t state; /* state, and in the upper four bits the cause of a fault */
    uint8_t n_values; /* number of elements: as the stream mask says, lowest bit first */
};
static inline struct msg_sample read_sample(const uint8_t *p, uint8_t length)
{
    struct msg_sample m;
    m.tick = get_u16(p + 1);
    m.state = get_u8(p + 3);
    m.n_values = (uint8_t)((length - LENGTH_SAMPLE) / 2);
    return m;
}
static inline uint16_t sample_values(const uint8_t *p, uint8_t i)
{
    return get_u16(p + LENGTH_SAMPLE + (uint8_t)(2 * i));
}
static inline uint8_t write_sample(uint8_t *p, uint16_t tick, uint8_t state, const uint16_t *values, uint8_t n_values)
{
    uint8_t i;
    p[0] = MSG_SAMPLE;
    put_u16(p + 1, tick);
    put_u8(p + 3, state);
    for (i = 0; i < n_values; i++)
        put_u16(p + LENGTH_SAMPLE + (uint8_t)(2 * i), values[i]);
    return (uint8_t)(LENGTH_SAMPLE + 2 * n_values);
}

/* ack: answer to every command that has no answer of its own, and to every refused one */
struct msg_ack {
    uint8_t id; /* of the command */
    uint8_t code; /* code: 0 done, else why not */
    uint16_t detail; /* see enum code */
};
static inline struct msg_ack read_ack(const uint8_t *p)
{
    struct msg_ack m;
    m.id = get_u8(p + 1);
    m.code = get_u8(p + 2);
    m.detail = get_u16(p + 3);
    return m;
}
static inline uint8_t write_ack(uint8_t *p, uint8_t id, uint8_t code, uint16_t detail)
{
    p[0] = MSG_ACK;
    put_u8(p + 1, id);
    put_u8(p + 2, code);
    put_u16(p + 3, detail);
    return LENGTH_ACK;
}

/* identity: answer to identify */
struct msg_identity {
    uint8_t id; /* of the command */
    uint8_t protocol; /* version of this table */
    uint8_t major; /* version of the firmware */
    uint8_t minor; /* version of the firmware */
    uint8_t board; /* 1: ATmega328P at 16 MHz */
    uint8_t adc_bits; /* resolution of the analog inputs */
    uint8_t analog; /* number of analog inputs */
    uint16_t pwm_top; /* pulse width that is always on, counts */
    uint32_t pwm_hz; /* frequency of the pulse width modulation, Hz */
    uint16_t table; /* elements of the excitation table */
    uint16_t shortest; /* shortest period that configure takes, in periods of the pulse width modulation */
    uint16_t digest; /* CRC-16/XMODEM of the program memory */
};
static inline struct msg_identity read_identity(const uint8_t *p)
{
    struct msg_identity m;
    m.id = get_u8(p + 1);
    m.protocol = get_u8(p + 2);
    m.major = get_u8(p + 3);
    m.minor = get_u8(p + 4);
    m.board = get_u8(p + 5);
    m.adc_bits = get_u8(p + 6);
    m.analog = get_u8(p + 7);
    m.pwm_top = get_u16(p + 8);
    m.pwm_hz = get_u32(p + 10);
    m.table = get_u16(p + 14);
    m.shortest = get_u16(p + 16);
    m.digest = get_u16(p + 18);
    return m;
}
static inline uint8_t write_identity(uint8_t *p, uint8_t id, uint8_t protocol, uint8_t major, uint8_t minor, uint8_t board, uint8_t adc_bits, uint8_t analog, uint16_t pwm_top, uint32_t pwm_hz, uint16_t table, uint16_t shortest, uint16_t digest)
{
    p[0] = MSG_IDENTITY;
    put_u8(p + 1, id);
    put_u8(p + 2, protocol);
    put_u8(p + 3, major);
    put_u8(p + 4, minor);
    put_u8(p + 5, board);
    put_u8(p + 6, adc_bits);
    put_u8(p + 7, analog);
    put_u16(p + 8, pwm_top);
    put_u32(p + 10, pwm_hz);
    put_u16(p + 14, table);
    put_u16(p + 16, shortest);
    put_u16(p + 18, digest);
    return LENGTH_IDENTITY;
}

/* status: answer to ask_status; with id 0 unasked, every 256 ticks */
struct msg_status {
    uint8_t id; /* of the command, or 0 */
    uint8_t state; /* state */
    uint8_t cause; /* cause of the last fault since clear */
    uint32_t ticks; /* since start */
    uint32_t fault_tick; /* tick of the last fault */
    uint16_t overruns; /* ticks that came too early, and pulse widths that acted a period later than they should, since reset */
    uint16_t dropped; /* frames that found no room in the transmit buffer, since reset */
    uint16_t rx_errors; /* received frames of wrong CRC, length or code, since reset */
    uint16_t rx_lost; /* received bytes that were lost or had no stop bit, since reset; a run of them that found no room counts once or more */
    uint16_t busy_us; /* longest work of one tick since start, microseconds */
    uint16_t supply_mv; /* supply voltage by the internal reference, mV; 0: not measured yet */
};
static inline struct msg_status read_status(const uint8_t *p)
{
    struct msg_status m;
    m.id = get_u8(p + 1);
    m.state = get_u8(p + 2);
    m.cause = get_u8(p + 3);
    m.ticks = get_u32(p + 4);
    m.fault_tick = get_u32(p + 8);
    m.overruns = get_u16(p + 12);
    m.dropped = get_u16(p + 14);
    m.rx_errors = get_u16(p + 16);
    m.rx_lost = get_u16(p + 18);
    m.busy_us = get_u16(p + 20);
    m.supply_mv = get_u16(p + 22);
    return m;
}
static inline uint8_t write_status(uint8_t *p, uint8_t id, uint8_t state, uint8_t cause, uint32_t ticks, uint32_t fault_tick, uint16_t overruns, uint16_t dropped, uint16_t rx_errors, uint16_t rx_lost, uint16_t busy_us, uint16_t supply_mv)
{
    p[0] = MSG_STATUS;
    put_u8(p + 1, id);
    put_u8(p + 2, state);
    put_u8(p + 3, cause);
    put_u32(p + 4, ticks);
    put_u32(p + 8, fault_tick);
    put_u16(p + 12, overruns);
    put_u16(p + 14, dropped);
    put_u16(p + 16, rx_errors);
    put_u16(p + 18, rx_lost);
    put_u16(p + 20, busy_us);
    put_u16(p + 22, supply_mv);
    return LENGTH_STATUS;
}

/* self_test_result: answer to self_test */
struct msg_self_test_result {
    uint8_t id; /* of the command */
    uint16_t failed; /* bits failed */
    uint16_t supply_mv; /* supply voltage, mV */
    uint16_t free_bytes; /* memory that the stack never used */
    uint16_t position; /* counts, mean of 16 */
    uint16_t current; /* counts, mean of 16, output off */
};
static inline struct msg_self_test_result read_self_test_result(const uint8_t *p)
{
    struct msg_self_test_result m;
    m.id = get_u8(p + 1);
    m.failed = get_u16(p + 2);
    m.supply_mv = get_u16(p + 4);
    m.free_bytes = get_u16(p + 6);
    m.position = get_u16(p + 8);
    m.current = get_u16(p + 10);
    return m;
}
static inline uint8_t write_self_test_result(uint8_t *p, uint8_t id, uint16_t failed, uint16_t supply_mv, uint16_t free_bytes, uint16_t position, uint16_t current)
{
    p[0] = MSG_SELF_TEST_RESULT;
    put_u8(p + 1, id);
    put_u16(p + 2, failed);
    put_u16(p + 4, supply_mv);
    put_u16(p + 6, free_bytes);
    put_u16(p + 8, position);
    put_u16(p + 10, current);
    return LENGTH_SELF_TEST_RESULT;
}

/* fault: sent once, at once, when the safe state is entered */
struct msg_fault {
    uint8_t cause; /* cause */
    uint32_t tick; /* tick since start */
    uint16_t position; /* counts */
    uint16_t current; /* counts */
};
static inline struct msg_fault read_fault(const uint8_t *p)
{
    struct msg_fault m;
    m.cause = get_u8(p + 1);
    m.tick = get_u32(p + 2);
    m.position = get_u16(p + 6);
    m.current = get_u16(p + 8);
    return m;
}
static inline uint8_t write_fault(uint8_t *p, uint8_t cause, uint32_t tick, uint16_t position, uint16_t current)
{
    p[0] = MSG_FAULT;
    put_u8(p + 1, cause);
    put_u32(p + 2, tick);
    put_u16(p + 6, position);
    put_u16(p + 8, current);
    return LENGTH_FAULT;
}

/* law_status: answer to ask_law; with id 0 unasked, when the controller returned to the law before the one on trial */
struct msg_law_status {
    uint8_t id; /* of the command, or 0 */
    uint8_t running; /* runs */
    uint8_t trial; /* 1: on trial */
    uint8_t cause; /* back_out: why the controller last returned to the law before */
    uint32_t tick; /* of that, since start */
    uint16_t position; /* then, counts */
};
static inline struct msg_law_status read_law_status(const uint8_t *p)
{
    struct msg_law_status m;
    m.id = get_u8(p + 1);
    m.running = get_u8(p + 2);
    m.trial = get_u8(p + 3);
    m.cause = get_u8(p + 4);
    m.tick = get_u32(p + 5);
    m.position = get_u16(p + 9);
    return m;
}
static inline uint8_t write_law_status(uint8_t *p, uint8_t id, uint8_t running, uint8_t trial, uint8_t cause, uint32_t tick, uint16_t position)
{
    p[0] = MSG_LAW_STATUS;
    put_u8(p + 1, id);
    put_u8(p + 2, running);
    put_u8(p + 3, trial);
    put_u8(p + 4, cause);
    put_u32(p + 5, tick);
    put_u16(p + 9, position);
    return LENGTH_LAW_STATUS;
}

/* identify: who are you; any state; the number of the last command is forgotten */
struct msg_identify {
    uint8_t id; /* number of the command, 1 to 255 */
};
static inline struct msg_identify read_identify(const uint8_t *p)
{
    struct msg_identify m;
    m.id = get_u8(p + 1);
    return m;
}
static inline uint8_t write_identify(uint8_t *p, uint8_t id)
{
    p[0] = MSG_IDENTIFY;
    put_u8(p + 1, id);
    return LENGTH_IDENTIFY;
}

/* configure: sampling; idle only; refused where a sample would not fit into the period at 11 us a byte; a new period makes gains invalid */
struct msg_configure {
    uint8_t id; /* number of the command */
    uint16_t period; /* of a tick, in periods of the pulse width modulation; the output is on only with 8 to 20 */
    uint8_t stream; /* mask of what a sample carries; analog inputs 0 and 1 are always converted, 2 only if it is in the mask */
};
static inline struct msg_configure read_configure(const uint8_t *p)
{
    struct msg_configure m;
    m.id = get_u8(p + 1);
    m.period = get_u16(p + 2);
    m.stream = get_u8(p + 4);
    return m;
}
static inline uint8_t write_configure(uint8_t *p, uint8_t id, uint16_t period, uint8_t stream)
{
    p[0] = MSG_CONFIGURE;
    put_u8(p + 1, id);
    put_u16(p + 2, period);
    put_u8(p + 4, stream);
    return LENGTH_CONFIGURE;
}

/* limits: what the controller holds to, whatever else it is told; idle, sampling or fault. An end of a trip at an end of the converter would never trip: refused, but for one end of the current (a sensor of one sign), and for 0 to 1023 of the position, which says that there is none (no levitation then) */
struct msg_limits {
    uint8_t id; /* number of the command */
    uint16_t position_low; /* counts; below: out_of_gap */
    uint16_t position_high; /* counts; above: out_of_gap */
    uint16_t current_low; /* counts; below: over_current */
    uint16_t current_high; /* counts; above: over_current */
    uint16_t duty_low; /* least pulse width, counts */
    uint16_t duty_high; /* largest pulse width, counts */
    uint16_t duty_off; /* pulse width of no voltage, counts: with the output off, and about which drive works without gains; not above the cap of duty_high that was compiled in */
    uint16_t host_ms; /* longest silence of the host while the output is on, 20 to 2000 ms */
    uint16_t lift_ms; /* time after start of drive or levitation in which out_of_gap does not count, 0 to 2000 ms; it ends early once the position was inside for 100 ms */
};
static inline struct msg_limits read_limits(const uint8_t *p)
{
    struct msg_limits m;
    m.id = get_u8(p + 1);
    m.position_low = get_u16(p + 2);
    m.position_high = get_u16(p + 4);
    m.current_low = get_u16(p + 6);
    m.current_high = get_u16(p + 8);
    m.duty_low = get_u16(p + 10);
    m.duty_high = get_u16(p + 12);
    m.duty_off = get_u16(p + 14);
    m.host_ms = get_u16(p + 16);
    m.lift_ms = get_u16(p + 18);
    return m;
}
static inline uint8_t write_limits(uint8_t *p, uint8_t id, uint16_t position_low, uint16_t position_high, uint16_t current_low, uint16_t current_high, uint16_t duty_low, uint16_t duty_high, uint16_t duty_off, uint16_t host_ms, uint16_t lift_ms)
{
    p[0] = MSG_LIMITS;
    put_u8(p + 1, id);
    put_u16(p + 2, position_low);
    put_u16(p + 4, position_high);
    put_u16(p + 6, current_low);
    put_u16(p + 8, current_high);
    put_u16(p + 10, duty_low);
    put_u16(p + 12, duty_high);
    put_u16(p + 14, duty_off);
    put_u16(p + 16, host_ms);
    put_u16(p + 18, lift_ms);
    return LENGTH_LIMITS;
}

/* gains: position loop; idle, sampling or levitating (changed between two ticks), not while a state-space law runs there; it takes the place of such a law; gains are within +-2^19. A change of duty_bias, kp or kc while levitating is not bumpless: the integral is kept, the pulse width jumps. See firmware/amb_daq/control.h */
struct msg_gains {
    uint8_t id; /* number of the command */
    int32_t kp; /* 2^-12 counts of pulse width per count of position */
    int32_t ki; /* 2^-16 counts of pulse width per count of position and tick */
    int32_t kd; /* 2^-12 counts of pulse width per count of position and tick: kd/(tau + T) */
    uint16_t pole; /* 2^-16: tau/(tau + T) of the derivative filter */
    int32_t kc; /* 2^-12 counts of pulse width per count of current */
    uint16_t setpoint; /* position, counts */
    uint16_t current_rest; /* current at rest, counts */
    uint16_t duty_bias; /* pulse width at rest, counts */
};
static inline struct msg_gains read_gains(const uint8_t *p)
{
    struct msg_gains m;
    m.id = get_u8(p + 1);
    m.kp = get_i32(p + 2);
    m.ki = get_i32(p + 6);
    m.kd = get_i32(p + 10);
    m.pole = get_u16(p + 14);
    m.kc = get_i32(p + 16);
    m.setpoint = get_u16(p + 20);
    m.current_rest = get_u16(p + 22);
    m.duty_bias = get_u16(p + 24);
    return m;
}
static inline uint8_t write_gains(uint8_t *p, uint8_t id, int32_t kp, int32_t ki, int32_t kd, uint16_t pole, int32_t kc, uint16_t setpoint, uint16_t current_rest, uint16_t duty_bias)
{
    p[0] = MSG_GAINS;
    put_u8(p + 1, id);
    put_i32(p + 2, kp);
    put_i32(p + 6, ki);
    put_i32(p + 10, kd);
    put_u16(p + 14, pole);
    put_i32(p + 16, kc);
    put_u16(p + 20, setpoint);
    put_u16(p + 22, current_rest);
    put_u16(p + 24, duty_bias);
    return LENGTH_GAINS;
}

/* setpoint: set point of the position; idle, sampling or levitating; within limits */
struct msg_setpoint {
    uint8_t id; /* number of the command */
    uint16_t setpoint; /* counts */
};
static inline struct msg_setpoint read_setpoint(const uint8_t *p)
{
    struct msg_setpoint m;
    m.id = get_u8(p + 1);
    m.setpoint = get_u16(p + 2);
    return m;
}
static inline uint8_t write_setpoint(uint8_t *p, uint8_t id, uint16_t setpoint)
{
    p[0] = MSG_SETPOINT;
    put_u8(p + 1, id);
    put_u16(p + 2, setpoint);
    return LENGTH_SETPOINT;
}

/* excitation: what is added to the pulse width once excite says so; not while it plays */
struct msg_excitation {
    uint8_t id; /* number of the command */
    uint8_t kind; /* kind */
    uint16_t amplitude; /* counts of pulse width */
    uint16_t hold; /* ticks per element, at least 1 */
    uint16_t length; /* elements of the table, or bits of the shift register (3 to 15) */
    uint16_t cycles; /* how often it is played; 0: until told to end */
    uint16_t seed; /* start of the shift register, not 0 */
};
static inline struct msg_excitation read_excitation(const uint8_t *p)
{
    struct msg_excitation m;
    m.id = get_u8(p + 1);
    m.kind = get_u8(p + 2);
    m.amplitude = get_u16(p + 3);
    m.hold = get_u16(p + 5);
    m.length = get_u16(p + 7);
    m.cycles = get_u16(p + 9);
    m.seed = get_u16(p + 11);
    return m;
}
static inline uint8_t write_excitation(uint8_t *p, uint8_t id, uint8_t kind, uint16_t amplitude, uint16_t hold, uint16_t length, uint16_t cycles, uint16_t seed)
{
    p[0] = MSG_EXCITATION;
    put_u8(p + 1, id);
    put_u8(p + 2, kind);
    put_u16(p + 3, amplitude);
    put_u16(p + 5, hold);
    put_u16(p + 7, length);
    put_u16(p + 9, cycles);
    put_u16(p + 11, seed);
    return LENGTH_EXCITATION;
}

/* table: elements of the excitation table; not while it plays */
struct msg_table {
    uint8_t id; /* number of the command */
    uint16_t offset; /* of the first element */
    uint8_t n_values; /* number of elements: up to 48 elements, -127 to 127 */
};
static inline struct msg_table read_table(const uint8_t *p, uint8_t length)
{
    struct msg_table m;
    m.id = get_u8(p + 1);
    m.offset = get_u16(p + 2);
    m.n_values = (uint8_t)((length - LENGTH_TABLE));
    return m;
}
static inline int8_t table_values(const uint8_t *p, uint8_t i)
{
    return get_i8(p + LENGTH_TABLE + i);
}
static inline uint8_t write_table(uint8_t *p, uint8_t id, uint16_t offset, const int8_t *values, uint8_t n_values)
{
    uint8_t i;
    p[0] = MSG_TABLE;
    put_u8(p + 1, id);
    put_u16(p + 2, offset);
    for (i = 0; i < n_values; i++)
        put_i8(p + LENGTH_TABLE + i, values[i]);
    return (uint8_t)(LENGTH_TABLE + n_values);
}

/* excite: begin (1) at the next tick, from its first element also while it plays, or end (0) the excitation; driving or levitating */
struct msg_excite {
    uint8_t id; /* number of the command */
    uint8_t on; /* 1 or 0 */
};
static inline struct msg_excite read_excite(const uint8_t *p)
{
    struct msg_excite m;
    m.id = get_u8(p + 1);
    m.on = get_u8(p + 2);
    return m;
}
static inline uint8_t write_excite(uint8_t *p, uint8_t id, uint8_t on)
{
    p[0] = MSG_EXCITE;
    put_u8(p + 1, id);
    put_u8(p + 2, on);
    return LENGTH_EXCITE;
}

/* start: begin: ticks count from 0; from idle, or from sampling to drive or levitate (ticks count on); the output goes on with the tick after the first one whose checks are passed, when the pulse width that this one ordered acts */
struct msg_start {
    uint8_t id; /* number of the command */
    uint8_t mode; /* mode */
};
static inline struct msg_start read_start(const uint8_t *p)
{
    struct msg_start m;
    m.id = get_u8(p + 1);
    m.mode = get_u8(p + 2);
    return m;
}
static inline uint8_t write_start(uint8_t *p, uint8_t id, uint8_t mode)
{
    p[0] = MSG_START;
    put_u8(p + 1, id);
    put_u8(p + 2, mode);
    return LENGTH_START;
}

/* stop: output off and idle; any state but fault, from which only samples stop */
struct msg_stop {
    uint8_t id; /* number of the command */
};
static inline struct msg_stop read_stop(const uint8_t *p)
{
    struct msg_stop m;
    m.id = get_u8(p + 1);
    return m;
}
static inline uint8_t write_stop(uint8_t *p, uint8_t id)
{
    p[0] = MSG_STOP;
    put_u8(p + 1, id);
    return LENGTH_STOP;
}

/* clear: leave the safe state to idle; fault only, and only if its cause is gone; out_of_gap, host_silent and overrun always are */
struct msg_clear {
    uint8_t id; /* number of the command */
};
static inline struct msg_clear read_clear(const uint8_t *p)
{
    struct msg_clear m;
    m.id = get_u8(p + 1);
    return m;
}
static inline uint8_t write_clear(uint8_t *p, uint8_t id)
{
    p[0] = MSG_CLEAR;
    put_u8(p + 1, id);
    return LENGTH_CLEAR;
}

/* ping: the host is there; any state */
struct msg_ping {
    uint8_t id; /* number of the command */
};
static inline struct msg_ping read_ping(const uint8_t *p)
{
    struct msg_ping m;
    m.id = get_u8(p + 1);
    return m;
}
static inline uint8_t write_ping(uint8_t *p, uint8_t id)
{
    p[0] = MSG_PING;
    put_u8(p + 1, id);
    return LENGTH_PING;
}

/* ask_status: answered by status; any state */
struct msg_ask_status {
    uint8_t id; /* number of the command */
};
static inline struct msg_ask_status read_ask_status(const uint8_t *p)
{
    struct msg_ask_status m;
    m.id = get_u8(p + 1);
    return m;
}
static inline uint8_t write_ask_status(uint8_t *p, uint8_t id)
{
    p[0] = MSG_ASK_STATUS;
    put_u8(p + 1, id);
    return LENGTH_ASK_STATUS;
}

/* self_test: answered by self_test_result; idle only */
struct msg_self_test {
    uint8_t id; /* number of the command */
};
static inline struct msg_self_test read_self_test(const uint8_t *p)
{
    struct msg_self_test m;
    m.id = get_u8(p + 1);
    return m;
}
static inline uint8_t write_self_test(uint8_t *p, uint8_t id)
{
    p[0] = MSG_SELF_TEST;
    put_u8(p + 1, id);
    return LENGTH_SELF_TEST;
}

/* law: words of a state-space law that is to be armed; idle, sampling or levitating, not on trial, not while an excitation plays; a loaded excitation by the table is forgotten, as words and the table's last elements share memory. See firmware/amb_daq/law.h */
struct msg_law {
    uint8_t id; /* number of the command */
    uint8_t offset; /* of the first word */
    uint8_t n_words; /* number of elements: n + 256 * shift, d0, d1; then of each of n states: shift, self, other, b0, b1, g, c */
};
static inline struct msg_law read_law(const uint8_t *p, uint8_t length)
{
    struct msg_law m;
    m.id = get_u8(p + 1);
    m.offset = get_u8(p + 2);
    m.n_words = (uint8_t)((length - LENGTH_LAW) / 2);
    return m;
}
static inline int16_t law_words(const uint8_t *p, uint8_t i)
{
    return get_i16(p + LENGTH_LAW + (uint8_t)(2 * i));
}
static inline uint8_t write_law(uint8_t *p, uint8_t id, uint8_t offset, const int16_t *words, uint8_t n_words)
{
    uint8_t i;
    p[0] = MSG_LAW;
    put_u8(p + 1, id);
    put_u8(p + 2, offset);
    for (i = 0; i < n_words; i++)
        put_i16(p + LENGTH_LAW + (uint8_t)(2 * i), words[i]);
    return (uint8_t)(LENGTH_LAW + 2 * n_words);
}

/* arm: the words are whole: run them instead of gains or law, after gains. Idle or sampling: from the next start. Levitating: from the next tick, on trial; what ran before returns where the rotor leaves the bounds, or without settle in time. Detail 1 of range: words that could overflow */
struct msg_arm {
    uint8_t id; /* number of the command */
    uint16_t period; /* of a tick for which the law was made, in periods of the pulse width modulation: that of configure, else refused */
    uint16_t checksum; /* CRC-16/XMODEM of the words 0 to 2 + 7 n, low bytes first */
    uint16_t position_low; /* bound of the trial, counts: above limits.position_low, below the set point */
    uint16_t position_high; /* bound of the trial, counts: below limits.position_high, above the set point */
    uint16_t confirm_ms; /* time for settle, 20 to 20000 ms; 0 in idle or sampling */
};
static inline struct msg_arm read_arm(const uint8_t *p)
{
    struct msg_arm m;
    m.id = get_u8(p + 1);
    m.period = get_u16(p + 2);
    m.checksum = get_u16(p + 4);
    m.position_low = get_u16(p + 6);
    m.position_high = get_u16(p + 8);
    m.confirm_ms = get_u16(p + 10);
    return m;
}
static inline uint8_t write_arm(uint8_t *p, uint8_t id, uint16_t period, uint16_t checksum, uint16_t position_low, uint16_t position_high, uint16_t confirm_ms)
{
    p[0] = MSG_ARM;
    put_u8(p + 1, id);
    put_u16(p + 2, period);
    put_u16(p + 4, checksum);
    put_u16(p + 6, position_low);
    put_u16(p + 8, position_high);
    put_u16(p + 10, confirm_ms);
    return LENGTH_ARM;
}

/* settle: end of the trial; levitating, on trial */
struct msg_settle {
    uint8_t id; /* number of the command */
    uint8_t keep; /* 1: the new law stays; 0: what ran before returns */
};
static inline struct msg_settle read_settle(const uint8_t *p)
{
    struct msg_settle m;
    m.id = get_u8(p + 1);
    m.keep = get_u8(p + 2);
    return m;
}
static inline uint8_t write_settle(uint8_t *p, uint8_t id, uint8_t keep)
{
    p[0] = MSG_SETTLE;
    put_u8(p + 1, id);
    put_u8(p + 2, keep);
    return LENGTH_SETTLE;
}

/* ask_law: answered by law_status; any state */
struct msg_ask_law {
    uint8_t id; /* number of the command */
};
static inline struct msg_ask_law read_ask_law(const uint8_t *p)
{
    struct msg_ask_law m;
    m.id = get_u8(p + 1);
    return m;
}
static inline uint8_t write_ask_law(uint8_t *p, uint8_t id)
{
    p[0] = MSG_ASK_LAW;
    put_u8(p + 1, id);
    return LENGTH_ASK_LAW;
}

#endif
