/*
 * Pins, timers and the chain of conversions of the ATmega328P. Timer 1 makes the pulse width, timer 2 the ticks: an exact number of periods of it.
 *
 * Timer 2 counts at clock/32: 25 counts a period. Its interrupt comes each `base` periods, at most 10 (0.5 ms), and each
 * `share`-th is a tick; in all of them the interlock and the receive line are looked at.
 *
 * A tick, in us from the begin of a period of 50 us:
 *   -8 current, 25 position, 58 current are held: interrupts wait for that count of timer 1; at 85 or so the third input
 *   53 the position is there: with the output on the law begins, with interrupts enabled, and looks itself for the
 *      inputs that come meanwhile; what is to be sent waits until it is done
 *   150 to 200 the pulse width is ordered; it acts from 200 on, 175 us after the position was held
 * The current is the mean of its two, so that both inputs stand for the same moment; and the ripple of the current, which
 * around the begin of a period does not depend on the pulse width to first order, leaves no error that looks like
 * resistance. A position 26 us off the current, and a current from the middle of the pause, made R 0.15 % too large.
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* it runs in each tick */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "board_inside.h"
#include "daq.h"
#include "flash.h"
#include "safety.h"
#include "tick.h"

#define LONGEST_BASE 10
#define COUNTS_PER_PERIOD 25 /* of timer 2 */
#define COUNT_US 2
#define PHASE 419        /* counts of timer 1 at the tick: the way to the first conversion, and some 5 us to spare */
#define HUNG_PERIODS 240 /* 12 ms, before the watchdog resets after 16 ms */
#define FIRST_CURRENT 0  /* steps of the conversions of a tick */
#define POSITION_STEP 1
#define SECOND_CURRENT 2
#define START_LEAD 14    /* counts of timer 1 from its reading to the start of the conversion */
#define HOLD 48          /* and from there until the input is held: 1.5 clocks of the converter */
#define TIMER_1(us) ((us) * 16 - HOLD - START_LEAD)
#define ORDER_EARLIEST 88 /* counts of timer 2 from the tick, which is 22 us before the begin of a period: 154 us */
#define ORDER_LATEST 120  /* later than the begin of the period from which it should act */
enum { POSITION, CURRENT, THIRD };
static const uint8_t order_of_inputs[] FLASH = {CURRENT, POSITION, CURRENT, THIRD};
/* Counts of timer 1; the last is over when the third input's turn comes, which therefore starts at once. */
static const uint16_t start_at[] FLASH = {TIMER_1(50 - 8), TIMER_1(25), TIMER_1(8), TIMER_1(28)};
static volatile uint8_t sampling, working, steps_wanted, step;
static uint8_t awaited; /* step whose conversion the work of the tick looks for, 0: none */
static uint16_t first_current;
static volatile uint8_t base = LONGEST_BASE;
static volatile uint16_t share = 1, share_left = 1;
static volatile uint8_t readings = 2, open_readings, low_readings;
static volatile uint16_t beats;
static volatile uint8_t unfed; /* periods since the watchdog was fed */

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
    TCCR1A = _BV(WGM11);
    TCCR1B = _BV(WGM13) | _BV(WGM12);
    ICR1 = BOARD_PWM_TOP - 1; /* taken only in a mode that has it as its top */
    OCR1A = 0;
    TCNT1 = 0;
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
    uint8_t by_watchdog = board_was_hung();
    cli();
    begin_pins();
    begin_timers();
    ADMUX = _BV(REFS0);
    ADCSRA = ADC_RUN;
    board_measure(0); /* the first one takes longer */
    set_sleep_mode(SLEEP_MODE_IDLE);
    wdt_enable(WDTO_15MS);
    board_begin_line(); /* last: what comes before interrupts do would be lost unseen */
    sei();
    return by_watchdog;
}

/* Output ----------------------------------------------------------------------------------------------------------- */

void board_output(uint8_t on)
{
    if (on) {
        BOARD_FLAGS |= RISING;
    } else {
        BOARD_FLAGS &= (uint8_t)~RISING;
        PORTB &= (uint8_t)~_BV(PORTB0);
    }
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

/* Timer 2 from 0 to `top` at the phase of timer 1; 0: that was over. Interrupts are off. */
static uint8_t begin_base(uint8_t top)
{
    if (TCNT1 >= PHASE)
        return 0;
    while (TCNT1 < PHASE)
        ;
    GTCCR = _BV(PSRASY);
    OCR2A = top;
    TCNT2 = 0;
    TIFR2 = _BV(OCF2A);
    return 1;
}

/* Waits, with interrupts, until the phase of timer 1 is less than 6 us ahead. */
static void await_phase(void)
{
    uint16_t now;
    do {
        ATOMICALLY { now = TCNT1; }
    } while (now < PHASE - 90 || now > PHASE - 40);
}

void board_ticks_start(uint16_t period, uint8_t inputs)
{
    uint8_t periods = largest_base(period), begun = 0, lines = (uint8_t)(LONGEST_BASE / periods + 1);
    uint8_t top = (uint8_t)(periods * COUNTS_PER_PERIOD - 1);
    uint16_t each = period / periods;
    board_measure(0); /* the first one after sleep takes longer */
    steps_wanted = (uint8_t)(inputs + 1); /* the current twice */
    while (!begun) {
        await_phase();
        ATOMICALLY
        {
            begun = begin_base(top);
            if (begun) {
                base = periods;
                readings = lines;
                open_readings = low_readings = 0;
                share = share_left = each;
                working = awaited = 0;
                ADCSRA = ADC_RUN | _BV(ADIF);
                sampling = 1;
            }
        }
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
    return (board_bad_bytes >= BAD_BYTES && !(BOARD_FLAGS & SOUND_BYTE)) || low_readings >= readings;
}

static inline void watch_lines(void)
{
    uint8_t pins = PIND;
    if ((pins & _BV(PIND0)) || (BOARD_FLAGS & BYTE_CAME) || board_deaf())
        low_readings = 0;
    else if (low_readings < 255)
        low_readings++;
    BOARD_FLAGS &= (uint8_t)~BYTE_CAME;
#if BOARD_INTERLOCK
    if (!(pins & _BV(PIND7)))
        open_readings = 0;
    else if (open_readings < 255)
        open_readings++;
#endif
}

/* Starts the conversion of a step, at its count of timer 1 unless that is over: up to 24 us late it waits for nothing, and
 * nothing keeps an interrupt waiting for so long. In time it waits 12 us at most. */
static inline void start_conversion(uint8_t next)
{
    uint16_t at = flash_u16(&start_at[next]), now;
    ADMUX = (uint8_t)(_BV(REFS0) | flash_u8(&order_of_inputs[next]));
    do
        now = TCNT1;
    while (now < at || now > at + BOARD_PWM_TOP / 2);
    ADCSRA = ADC_RUN | _BV(ADIE) | _BV(ADSC) | _BV(ADIF);
}

/* The main loop hangs, though interrupts still come: nothing of the program is trusted any more. The watchdog follows. */
static void __attribute__((noinline)) hang(void)
{
    board_output(0);
    board_note_hung();
    for (;;)
        ;
}

static inline void watch(void)
{
    beats++;
    unfed = (uint8_t)(unfed + base);
    if (unfed > HUNG_PERIODS)
        hang();
    watch_lines();
    if (line_broken() || open_readings >= readings) {
        if (daq_output_on())
            safety_enter(line_broken() ? CAUSE_LINE_BREAK : CAUSE_INTERLOCK);
    }
}

ISR(TIMER2_COMPA_vect)
{
    if (sampling && --share_left == 0) {
        share_left = share;
        if (tick_begin(working)) {
            if (BOARD_FLAGS & RISING)
                PORTB |= _BV(PORTB0);
            working = 1;
            step = FIRST_CURRENT;
            start_conversion(FIRST_CURRENT);
        }
    }
    watch();
}

/* Since the last tick, in counts of timer 2: by it and its interrupts since. Interrupts are off. */
static inline uint16_t since_tick(void)
{
    uint16_t counts = TCNT2;
    if (TIFR2 & _BV(OCF2A))
        counts = (uint16_t)(TCNT2 + base * COUNTS_PER_PERIOD);
    return (uint16_t)(counts + (share - share_left) * base * COUNTS_PER_PERIOD);
}

/* A pulse width that is ordered in time acts from a fixed period on: not in the one before, as the law may be done early,
 * so that the order waits. With an order that waits for nothing R came out 0.8 % wrong. */
void board_await_order(void)
{
    uint16_t counts;
    do {
        ATOMICALLY { counts = since_tick(); }
    } while (counts < ORDER_EARLIEST);
}

uint8_t board_order_waits(void)
{
    uint16_t counts;
    ATOMICALLY { counts = since_tick(); }
    return counts < ORDER_EARLIEST - 20;
}

uint8_t board_order_late(void)
{
    uint16_t counts = since_tick();
    return counts > ORDER_LATEST || (counts > ORDER_EARLIEST + 12 && TCNT1 < BOARD_PWM_TOP / 2);
}

static inline void keep_input(uint8_t done, uint16_t counts)
{
    if (done == FIRST_CURRENT)
        first_current = counts;
    else if (done == SECOND_CURRENT)
        daq.inputs[CURRENT] = (uint16_t)((first_current + counts + 1) / 2);
    else
        daq.inputs[done == POSITION_STEP ? POSITION : THIRD] = counts;
}

void board_await_input(uint8_t input)
{
    while (awaited && (input == CURRENT ? awaited == SECOND_CURRENT : 1)) {
        uint8_t done = awaited, next = (uint8_t)(done + 1);
        while (ADCSRA & _BV(ADSC))
            ;
        keep_input(done, ADC);
        awaited = next < steps_wanted ? next : 0;
        if (awaited) {
            ADMUX = _BV(REFS0) | THIRD;
            ADCSRA = ADC_RUN | _BV(ADSC) | _BV(ADIF);
        }
    }
}

static inline void work(void)
{
    sei();
    tick_work();
    board_await_input(THIRD);
    board_send();
    cli();
    uint16_t us = (uint16_t)(since_tick() * COUNT_US);
    if (us > daq.busy_us)
        daq.busy_us = us;
    working = 0;
}

/* The next conversion starts before the last one's result is read, which stands until the next one's is there. */
ISR(ADC_vect)
{
    uint8_t done = step, next = (uint8_t)(done + 1), last = next >= steps_wanted, early;
    if (!sampling) {
        working = 0;
        return;
    }
    if (!last) {
        start_conversion(next);
        step = next;
    }
    keep_input(done, ADC);
    early = done == POSITION_STEP && daq_output_on();
    if (early) {
        ADCSRA = ADC_RUN; /* without its interrupt; the conversion goes on */
        awaited = next;
        board_send_later();
    }
    if (last || early)
        work();
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

void board_feed(void)
{
    wdt_reset();
    unfed = 0;
}

uint16_t board_alive(void)
{
    static uint8_t before;
    uint16_t now;
    ATOMICALLY { now = beats; }
    if ((uint8_t)now != before)
        board_feed();
    before = (uint8_t)now;
    return now;
}

/* Falling asleep starts a conversion by itself while the converter is on: so it is off then, and there is no sleep while
 * ticks want their conversions at fixed times. Interrupts wait from the question until the processor sleeps: none that gives work can slip in between. */
void board_sleep(uint8_t (*pending)(void))
{
    uint8_t now = (uint8_t)beats;
    if (sampling) {
        while ((uint8_t)beats == now && !pending())
            ;
        return;
    }
    ADCSRA = 0;
    cli();
    if (!pending()) {
        sleep_enable();
        sei();
        sleep_cpu();
        sleep_disable();
    }
    sei();
    ADCSRA = ADC_RUN;
}
#else
typedef int board_is_not_this_one; /* a C file must not be empty */
#endif
