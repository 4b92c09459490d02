/*
 * Pins, timers and the chain of conversions of the ATmega328P. Timer 1 makes the pulse width, timer 2 the ticks: an exact number of periods of it.
 *
 * Timer 2 counts at clock/32: 25 counts a period. Its interrupt comes each `base` periods, at most 10 (0.5 ms), and each
 * `share`-th is a tick; in all of them the interlock and the receive line are looked at. The tick starts the first
 * conversion, each conversion the next, and the last one calls the work of the tick with interrupts enabled.
 *
 * Order and phase: current, position, current, third input, some 31 us apart; the current is the mean of its two. They
 * are held 6 us before and 6 us after the begin of a period of 50 us, with the position in the middle between them. So
 * both stand for the same moment, and the ripple of the current, which around the begin of a period does not depend on
 * the pulse width to first order, leaves no error that looks like resistance. A position 26 us off the current, and a
 * current from the middle of the pause, made R 0.15 % too large.
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* it runs in each tick */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "board_inside.h"
#include "daq.h"
#include "safety.h"
#include "tick.h"

#define LONGEST_BASE 10
#define COUNTS_PER_PERIOD 25 /* of timer 2 */
#define COUNT_US 2
#define PHASE 489            /* counts of timer 1 at the tick, less the way to the first conversion */
#define FIRST_CURRENT 0 /* steps of the conversions of a tick */
#define SECOND_CURRENT 2
#define LATE 500 /* counts of timer 1: from here on a pulse width waits for the next period */
enum { POSITION, CURRENT, THIRD };
static const uint8_t order_of_inputs[] = {CURRENT, POSITION, CURRENT, THIRD};
static volatile uint8_t sampling, working, steps_wanted, step;
static uint16_t first_current;
static volatile uint8_t base = LONGEST_BASE;
static volatile uint16_t share = 1, share_left = 1;
static volatile uint8_t readings = 2, open_readings, low_readings;
static volatile uint16_t beats;

/* Setup ------------------------------------------------------------------------------------------------------------ */

static void begin_pins(void)
{
    PORTB = 0;
    PORTC = 0;
    PORTD = _BV(PORTD7) | _BV(PORTD0); /* pull-ups: an open loop and a loose line read high */
    DDRB = _BV(DDB0) | _BV(DDB1) | _BV(DDB5);
    DDRC = 0;
    DDRD = _BV(DDD1);
    DIDR0 = _BV(ADC0D) | _BV(ADC1D) | _BV(ADC2D);
}

static void begin_timers(void)
{
    TIMSK0 = 0; /* the Arduino core's clock: its interrupts would come between ours */
    TCCR0B = 0;
    TIMSK1 = 0;
    TCCR1B = 0;
    ICR1 = BOARD_PWM_TOP - 1;
    OCR1A = 0;
    TCNT1 = 0;
    TCCR1A = _BV(WGM11);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);
    TIMSK2 = 0;
    ASSR = 0;
    TCCR2A = _BV(WGM21);
    TCCR2B = _BV(CS21) | _BV(CS20);
    OCR2A = LONGEST_BASE * COUNTS_PER_PERIOD - 1;
    TCNT2 = 0;
    TIFR2 = _BV(OCF2A);
    TIMSK2 = _BV(OCIE2A);
}

uint8_t board_begin(void)
{
    uint8_t by_watchdog = board_reset_cause & _BV(WDRF);
    cli();
    begin_pins();
    begin_timers();
    board_begin_line();
    ADMUX = _BV(REFS0);
    ADCSRA = ADC_RUN;
    board_measure(0); /* the first one takes longer */
    set_sleep_mode(SLEEP_MODE_IDLE);
    wdt_enable(WDTO_250MS);
    sei();
    return by_watchdog != 0;
}

/* Output ----------------------------------------------------------------------------------------------------------- */

void board_output(uint8_t on)
{
    if (on)
        PORTB |= _BV(PORTB0);
    else
        PORTB &= (uint8_t)~_BV(PORTB0);
}

void board_duty(uint16_t duty)
{
    ATOMICALLY
    {
        if (duty) {
            OCR1A = (uint16_t)(duty - 1);
            TCCR1A = _BV(COM1A1) | _BV(WGM11);
        } else {
            TCCR1A = _BV(WGM11);
            OCR1A = 0;
        }
    }
}

/* The law is done some 120 us after the position was held, and a period begins at 126 us. Without this the pulse width
 * acted now in that one and now in the next, 50 us later, as the bytes on the line had it: R came out 0.8 % wrong. */
void board_await_period(void)
{
    while (TCNT1 >= LATE)
        ;
}

void board_lamp(uint8_t on)
{
    if (on)
        PORTB |= _BV(PORTB5);
    else
        PORTB &= (uint8_t)~_BV(PORTB5);
}

/* Ticks ------------------------------------------------------------------------------------------------------------ */

static uint8_t largest_base(uint16_t period)
{
    uint8_t n = LONGEST_BASE;
    while (period % n)
        n--;
    return n;
}

static void begin_base(uint8_t periods)
{
    uint16_t now;
    base = periods;
    readings = (uint8_t)(LONGEST_BASE / periods + 1);
    open_readings = low_readings = 0;
    do
        now = TCNT1;
    while (now < PHASE || now > PHASE + 16);
    GTCCR = _BV(PSRASY);
    OCR2A = (uint8_t)(periods * COUNTS_PER_PERIOD - 1);
    TCNT2 = 0;
    TIFR2 = _BV(OCF2A);
}

void board_ticks_start(uint16_t period, uint8_t inputs)
{
    uint8_t periods = largest_base(period);
    ATOMICALLY
    {
        share = share_left = period / periods;
        steps_wanted = (uint8_t)(inputs + 1); /* the current twice */
        working = 0;
        ADCSRA = ADC_RUN | _BV(ADIF);
        begin_base(periods);
        sampling = 1;
    }
}

/* A conversion on its way ends by itself; its interrupt finds that nothing is wanted. */
void board_ticks_stop(void)
{
    ATOMICALLY { sampling = 0; }
}

/* No stop bits, or low without a byte in several readings: a byte is over in 10 us, readings are 50 us apart or more. */
static inline uint8_t line_broken(void)
{
    return board_bad_bytes >= BAD_BYTES || low_readings >= readings;
}

static inline void watch_lines(void)
{
    uint8_t pins = PIND;
    if ((pins & _BV(PIND0)) || board_byte_came)
        low_readings = 0;
    else if (low_readings < 255)
        low_readings++;
    board_byte_came = 0;
#if BOARD_INTERLOCK
    if (!(pins & _BV(PIND7)))
        open_readings = 0;
    else if (open_readings < 255)
        open_readings++;
#endif
}

ISR(TIMER2_COMPA_vect)
{
    beats++;
    watch_lines();
    if (line_broken() || open_readings >= readings) {
        if (daq_output_on())
            safety_enter(line_broken() ? CAUSE_LINE_BREAK : CAUSE_INTERLOCK);
    }
    if (!sampling || --share_left)
        return;
    share_left = share;
    if (tick_begin(working)) {
        working = 1;
        step = 0;
        ADMUX = _BV(REFS0) | CURRENT;
        ADCSRA = ADC_RUN | _BV(ADIE) | _BV(ADSC);
    }
}

/* Time since the last tick, by timer 2 and the interrupts since; interrupts are off. */
static inline void measure_busy(void)
{
    uint16_t us = (uint16_t)(TCNT2 * COUNT_US);
    if (TIFR2 & _BV(OCF2A))
        us = (uint16_t)(base * BOARD_PERIOD_US);
    us = (uint16_t)(us + (share - share_left) * base * BOARD_PERIOD_US);
    if (us > daq.busy_us)
        daq.busy_us = us;
}

ISR(ADC_vect)
{
    uint8_t done = step;
    uint16_t counts = ADC;
    if (done == FIRST_CURRENT)
        first_current = counts;
    else if (done == SECOND_CURRENT)
        daq.inputs[CURRENT] = (uint16_t)((first_current + counts + 1) / 2);
    else
        daq.inputs[order_of_inputs[done]] = counts;
    if (!sampling) {
        working = 0;
        return;
    }
    if (++done < steps_wanted) {
        step = done;
        ADMUX = (uint8_t)(_BV(REFS0) | order_of_inputs[done]);
        ADCSRA = ADC_RUN | _BV(ADIE) | _BV(ADSC);
        return;
    }
    sei();
    tick_work();
    cli();
    measure_busy();
    working = 0;
}

uint8_t board_interlock_open(void)
{
#if BOARD_INTERLOCK
    return (PIND & _BV(PIND7)) != 0;
#else
    return 0;
#endif
}

uint8_t board_line_broken(void)
{
    return line_broken();
}

/* Rest ------------------------------------------------------------------------------------------------------------- */

uint16_t board_alive(void)
{
    static uint16_t before;
    uint16_t now;
    ATOMICALLY { now = beats; }
    if (now != before)
        wdt_reset();
    before = now;
    return now;
}

/* Interrupts wait from the question until the processor sleeps: none that gives work can slip in between. */
void board_sleep(uint8_t (*pending)(void))
{
    cli();
    if (!pending()) {
        sleep_enable();
        sei();
        sleep_cpu();
        sleep_disable();
    }
    sei();
}
#else
typedef int board_is_not_this_one; /* a C file must not be empty */
#endif
