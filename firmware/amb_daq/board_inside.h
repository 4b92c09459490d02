/*
 * What the files of the board share among themselves.
 */
#ifndef AMB_DAQ_BOARD_INSIDE_H
#define AMB_DAQ_BOARD_INSIDE_H

#include "board.h"

#include <avr/io.h>

#define ADC_RUN (_BV(ADEN) | _BV(ADPS2) | _BV(ADPS0)) /* 500 kHz */
#define BAD_BYTES 4 /* without stop bit, one after the other: the line is broken */

extern volatile uint8_t board_byte_came; /* a sound byte, since the timer's last interrupt */
extern volatile uint8_t board_bad_bytes; /* without stop bit, since the last sound one */
extern uint8_t board_reset_cause;        /* MCUSR as the reset left it */

void board_begin_line(void);

#endif
