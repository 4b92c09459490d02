/*
 * Registers of the ATmega328P. Timer 1 makes the pulse width, timer 2 the ticks: an exact number of periods of it.
 *
 * Timer 2 counts at clock/32: 25 counts a period. Its interrupt comes each `base` periods, at most 10 (0.5 ms), and each
 * `share`-th is a tick; in all of them the interlock and the receive line are looked at. The tick starts the first
 * conversion, each conversion the next, and the last one calls the work of the tick with interrupts enabled.
 *
 * Phase: the tick comes 8.5 us after the begin of a period, so that the inputs are held (some 3 us later, and 26 us
 * apart) at 11.5, 37.5 and 13.5 us of a period of 50: in the middle of the pulse and of the pause at half pulse width,
 * far from both edges.
 */
#ifdef __AVR__
#include "board.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "crc16.h"
#include "daq.h"
#include "safety.h"
#include "tick.h"

#define LONGEST_BASE 10
#define COUNTS_PER_PERIOD 25 /* of timer 2 */
#define COUNT_US 2
#define PHASE 130            /* counts of timer 1 at the tick, less the way into its interrupt */
#define BAD_BYTES 4          /* without stop bit, one after the other: the line is broken */
#define PAINT 0xc5

#define ADC_RUN (_BV(ADEN) | _BV(ADPS2) | _BV(ADPS0)) /* 500 kHz */
#define ADC_SUPPLY_MUX (_BV(REFS0) | 0x0e)            /* the internal reference of 1.1 V against the supply */
#define REFERENCE_MV 1100UL

struct tx_ring board_tx;
struct rx_ring board_rx;

static volatile uint8_t sampling, working, inputs_wanted, channel;
static volatile uint8_t base = LONGEST_BASE;
static volatile uint16_t share = 1, share_left = 1;
static volatile uint8_t readings = 2, open_readings, low_readings;
static volatile uint8_t byte_came, bad_bytes;
static volatile uint16_t lost, beats;
static uint8_t reset_cause __attribute__((section(".noinit")));

extern uint8_t __heap_start, __stack, __data_load_end;

/* Before any C runs: paint the memory that the stack may use, note the cause of the reset, stop its watchdog. */
void board_paint(void) __attribute__((naked, used, section(".init3")));
void board_paint(void)
{
    uint8_t *p = &__heap_start;
    reset_cause = MCUSR;
    MCUSR = 0;
    wdt_disable();
    while (p <= &__stack)
        *p++ = PAINT;
}

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

static void begin_line(void)
{
    UCSR0B = 0;
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UBRR0H = 0;
    UBRR0L = F_CPU / (8 * PROTOCOL_BAUD) - 1;
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

uint8_t board_begin(void)
{
    uint8_t by_watchdog = reset_cause & _BV(WDRF);
    cli();
    begin_pins();
    begin_timers();
    begin_line();
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
        inputs_wanted = inputs;
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
    return bad_bytes >= BAD_BYTES || low_readings >= readings;
}

static inline void watch_lines(void)
{
    uint8_t pins = PIND;
    if ((pins & _BV(PIND0)) || byte_came)
        low_readings = 0;
    else if (low_readings < 255)
        low_readings++;
    byte_came = 0;
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
        channel = 0;
        ADMUX = _BV(REFS0);
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
    uint8_t done = channel;
    daq.inputs[done] = ADC;
    if (!sampling) {
        working = 0;
        return;
    }
    if (++done < inputs_wanted) {
        channel = done;
        ADMUX = (uint8_t)(_BV(REFS0) | done);
        ADCSRA = ADC_RUN | _BV(ADIE) | _BV(ADSC);
        return;
    }
    sei();
    tick_work();
    cli();
    measure_busy();
    working = 0;
}

/* Line ------------------------------------------------------------------------------------------------------------- */

ISR(USART_RX_vect)
{
    uint8_t status = UCSR0A, byte = UDR0;
    if (status & _BV(DOR0))
        lost += lost != 0xffff;
    if (status & _BV(FE0)) {
        bad_bytes += bad_bytes != 255;
        lost += lost != 0xffff;
        return;
    }
    bad_bytes = 0;
    byte_came = 1;
    if (!rx_put(&board_rx, byte))
        lost += lost != 0xffff;
}

ISR(USART_UDRE_vect)
{
    uint8_t tail = board_tx.tail;
    UDR0 = board_tx.data[tail++];
    board_tx.tail = tail;
    if (tail == board_tx.head)
        UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

void board_send(void)
{
    ATOMICALLY
    {
        if (board_tx.head != board_tx.tail)
            UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0) | _BV(UDRIE0);
    }
}

uint16_t board_rx_lost(void)
{
    uint16_t now;
    ATOMICALLY { now = lost; }
    return now;
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

/* Measuring without ticks ------------------------------------------------------------------------------------------ */

static uint16_t convert(uint8_t mux)
{
    while (ADCSRA & _BV(ADSC))
        ;
    ADMUX = mux;
    ADCSRA = ADC_RUN | _BV(ADSC) | _BV(ADIF);
    while (ADCSRA & _BV(ADSC))
        ;
    return ADC;
}

uint16_t board_measure(uint8_t input)
{
    return convert((uint8_t)(_BV(REFS0) | input));
}

/* The reference is weak: the first conversions charge the sampling capacitor. */
uint16_t board_supply_mv(void)
{
    uint16_t counts = 0;
    uint8_t i;
    for (i = 0; i < 64; i++)
        counts = convert(ADC_SUPPLY_MUX);
    ADMUX = _BV(REFS0);
    return counts ? (uint16_t)(REFERENCE_MV * 1024 / counts) : 0;
}

/* Self-test -------------------------------------------------------------------------------------------------------- */

uint16_t board_digest(void)
{
    uint16_t crc = 0, at;
    for (at = 0; at < (uint16_t)(uintptr_t)&__data_load_end; at++)
        crc = crc16_add(crc, pgm_read_byte(at));
    return crc;
}

uint16_t board_free_bytes(void)
{
    const uint8_t *p = &__heap_start;
    while (p <= &__stack && *p == PAINT)
        p++;
    return (uint16_t)(p - &__heap_start);
}

/* Each byte in turn, without interruption: an interrupt's stack may reach where no stack was before. */
uint8_t board_memory_sound(void)
{
    volatile uint8_t *p = &__heap_start, *end = p + board_free_bytes();
    uint8_t good = 1;
    for (; p < end; p++) {
        ATOMICALLY
        {
            if (*p == PAINT) {
                *p = 0x55;
                good &= *p == 0x55;
                *p = 0xaa;
                good &= *p == 0xaa;
                *p = PAINT;
            }
        }
    }
    return good;
}

/* The pin must follow when it is an output of the port, and the timer must run to its top. */
static uint8_t pin_follows(void)
{
    uint8_t good = 1;
    ATOMICALLY
    {
        TCCR1A = _BV(WGM11);
        PORTB &= (uint8_t)~_BV(PORTB1);
        __builtin_avr_delay_cycles(16);
        good &= !(PINB & _BV(PINB1));
        PORTB |= _BV(PORTB1);
        __builtin_avr_delay_cycles(16);
        good &= (PINB & _BV(PINB1)) != 0;
        PORTB &= (uint8_t)~_BV(PORTB1);
    }
    return good;
}

static uint8_t timer_runs(void)
{
    uint16_t now, highest = 0, lowest = 0xffff, i;
    for (i = 0; i < 1000; i++) {
        ATOMICALLY { now = TCNT1; }
        if (now > highest)
            highest = now;
        if (now < lowest)
            lowest = now;
    }
    return lowest < 50 && highest > BOARD_PWM_TOP - 50 && highest < BOARD_PWM_TOP;
}

uint8_t board_pwm_sound(void)
{
    uint8_t good = pin_follows() && timer_runs() && ICR1 == BOARD_PWM_TOP - 1;
    board_duty(BOARD_PWM_TOP / 4);
    good &= OCR1A == BOARD_PWM_TOP / 4 - 1;
    board_duty(daq.limits.duty_off);
    return good;
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
