/*
 * What the files of the board share among themselves.
 */
#ifndef AMB_DAQ_BOARD_INSIDE_H
#define AMB_DAQ_BOARD_INSIDE_H

#include "board.h"

#include <avr/io.h>

#define ADC_RUN (_BV(ADEN) | _BV(ADPS2) | _BV(ADPS0)) /* 500 kHz */
#define BAD_BYTES 4 /* without stop bit, one after the other: the line is broken */

/* Bits in a register that one instruction sets and clears. */
#define BOARD_FLAGS GPIOR0
#define SOUND_BYTE _BV(0) /* since the last one without stop bit */
#define RISING _BV(2)    /* ENABLE goes on at the next tick */
#define BYTE_CAME _BV(1)  /* a sound one, since the timer's last interrupt */

extern volatile uint8_t board_bad_bytes; /* without stop bit, one after the other, before a SOUND_BYTE */

void board_feed(void);        /* the watchdog */
void board_note_hung(void);   /* for the program that runs after the reset */
uint8_t board_was_hung(void); /* 1 if the last reset was the watchdog's; asked once */
void board_begin_line(void);
uint8_t board_deaf(void);       /* received bytes are left to be lost until board_receive */
void board_send_later(void); /* sends nothing more until board_send; interrupts are off */

#endif
