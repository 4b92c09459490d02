/*
 * Everything that is particular to the board: ATmega328P at 16 MHz, pins of the Arduino Uno. board_*.c alone touch
 * registers; another controller needs other ones (and the numbers below).
 *
 *   A0 position, A1 current, A2 third input    D9 (OC1A) pulse width, 20 kHz, on for `duty` of 800 counts
 *   D0/D1 serial line, 1 Mbaud 8N1             D8 power stage on (high)
 *   D7 interlock loop to ground, pull-up       D13 lamp: on while levitating, blinks after a fault
 *
 * OC1A is high for OCR1A + 1 of ICR1 + 1 = 800 counts: OCR1A = duty - 1. For a duty of 0 the compare output is taken off
 * the pin, which is low then: this kind of modulation knows no shorter pulse than one count.
 */
#ifndef AMB_DAQ_BOARD_H
#define AMB_DAQ_BOARD_H

#include <stdint.h>

#include "ring.h"

#define BOARD_KIND 1
#define BOARD_ADC_BITS 10
#define BOARD_ADC_TOP 1023
#define BOARD_ANALOG 3
#define BOARD_PWM_TOP 800
#define BOARD_PWM_HZ 20000UL
#define BOARD_PERIODS_PER_MS 20 /* periods of the pulse width in 1 ms */
#define BOARD_PERIOD_US 50      /* a period of the pulse width */
#define BOARD_SHORTEST 5        /* periods of a tick: 4 kHz, at which any stream is sent while commands come */
#define BOARD_LONGEST 20000     /* 1 Hz */
#define BOARD_BYTE_US 11        /* a byte on the line, with a tenth kept for answers */

/* The interlock can be compiled out (0) where a bench has none. */
#ifndef BOARD_INTERLOCK
#define BOARD_INTERLOCK 1
#endif

/* What happens inside runs without interruption. It takes less than 10 us: the hardware holds two bytes of 10 us, and the
 * longest interrupt (12 us, where it waits for the time of a conversion) may come right behind. */
#ifdef __AVR__
#include <util/atomic.h>
#define ATOMICALLY ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
#else
#define ATOMICALLY for (uint8_t once_ = 1; once_; once_ = 0)
#endif

extern struct tx_ring board_tx;
extern struct rx_ring board_rx;

/* Pins, timers, converter, line, watchdog; output off, pulse width 0. Returns 1 if the program hung before. */
uint8_t board_begin(void);

/* ENABLE: off at once; on at the begin of the next tick, when the pulse width that was ordered before acts. */
void board_output(uint8_t on);
void board_duty(uint16_t duty);

/* Waits until a pulse width that is ordered now acts at the fixed time after the tick. */
void board_await_order(void);
/* There are some 40 us left until then. */
uint8_t board_order_waits(void);
/* The order came too late for that, it acts a period later; asked with interrupts off, at once after the order. */
uint8_t board_order_late(void);
/* Waits until input 1 or 2 of this tick is in daq.inputs; the law begins when input 0 is there. */
void board_await_input(uint8_t input);
void board_lamp(uint8_t on);

/* Ticks of `period` periods of the pulse width, each of which converts `inputs` inputs and calls tick_work. */
void board_ticks_start(uint16_t period, uint8_t inputs);
void board_ticks_stop(void);

/* What the lines say now, without waiting for a second reading. */
uint8_t board_interlock_open(void);
uint8_t board_line_broken(void);

/* One conversion of input 0 to 2; only while there are no ticks. 26 us. */
uint16_t board_measure(uint8_t input);
/* Supply voltage in mV by the internal reference; only while there are no ticks. 2 ms. */
uint16_t board_supply_mv(void);

uint16_t board_digest(void);      /* CRC of the program memory; some 15 ms */
uint16_t board_free_bytes(void);  /* memory that the stack never reached */
uint8_t board_memory_sound(void); /* that memory holds what is written to it */
uint8_t board_pwm_sound(void);    /* period, read back compare value and pin are right; output off only */

/* Bytes that were lost or had no stop bit, since reset. */
uint16_t board_rx_lost(void);
/* There is room in board_rx again. */
void board_receive(void);
/* Sends what was put into board_tx. */
void board_send(void);
/* Keeps the watchdog quiet if the timer's interrupts went on since the last call; without it, ENABLE is low after 12 ms,
 * and by a reset after 16 ms, which also comes where there are no interrupts. Returns the count of these interrupts. */
uint16_t board_alive(void);
/* Sleeps until the next interrupt, unless `pending` says that one came in between. */
void board_sleep(uint8_t (*pending)(void));

#endif
