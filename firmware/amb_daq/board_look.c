/*
 * What the ATmega328P measures and tests of itself, without ticks.
 */
#ifdef __AVR__
#include <avr/pgmspace.h>
#include <avr/wdt.h>

#include "board_inside.h"
#include "crc16.h"
#include "daq.h"

#define PAINT 0xc5
#define ADC_SUPPLY_MUX (_BV(REFS0) | 0x0e) /* the internal reference of 1.1 V against the supply */
#define REFERENCE_MV 1100UL

#define HUNG 0x8a3cc5d1UL

static uint8_t reset_cause __attribute__((section(".noinit"))); /* MCUSR as the reset left it */
static uint32_t hung __attribute__((section(".noinit")));       /* HUNG: the program hung before the reset */

extern uint8_t __heap_start, __stack, __data_load_end;

/* Before any C runs: note the cause of the reset; stop the watchdog, which after its own reset runs on with 16 ms; paint
 * the memory that the stack may use. */
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

/* A bootloader may clear the cause, and may itself end by the watchdog after the reset button: so the word counts that is
 * left here before the watchdog. Where interrupts no longer came it is not left; then only the cause tells. */
void board_note_hung(void)
{
    hung = HUNG;
}

uint8_t board_was_hung(void)
{
    uint8_t was = hung == HUNG || ((reset_cause & _BV(WDRF)) && !(reset_cause & _BV(EXTRF)));
    if (reset_cause & _BV(PORF))
        was = 0;
    hung = 0;
    return was;
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
    for (at = 0; at < (uint16_t)(uintptr_t)&__data_load_end; at++) {
        board_feed(); /* all takes longer than the watchdog waits */
        crc = crc16_add(crc, pgm_read_byte(at));
    }
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
#else
typedef int board_look_is_not_this_one; /* a C file must not be empty */
#endif
