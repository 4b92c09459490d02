/*
 * The serial line of the ATmega328P: 1 Mbaud, rings filled and emptied by interrupts. A byte takes 10 us and the hardware
 * holds two, so that these interrupts are short and nothing keeps them waiting for long.
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* it runs for each byte */
#include <avr/interrupt.h>

#include "board_inside.h"
#include "protocol.h"

struct tx_ring board_tx;
struct rx_ring board_rx;
volatile uint8_t board_bad_bytes;

static volatile uint8_t lost; /* bytes, modulo 256 */

void board_begin_line(void)
{
    UCSR0B = 0;
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UBRR0H = 0;
    UBRR0L = F_CPU / (8 * PROTOCOL_BAUD) - 1;
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

/* A byte without stop bit is not passed on. One that overran the hardware is gone, the one that is read is sound.
 * With the line full this runs each 10 us: what must be done for a sound byte is done in few registers. Where there is no
 * room it runs no more until there is (board_receive): bytes that would be lost all the same must not keep the law waiting. */
ISR(USART_RX_vect)
{
    uint8_t status = UCSR0A, byte = UDR0;
    if (status & (_BV(DOR0) | _BV(FE0))) {
        lost++;
        if (status & _BV(FE0)) {
            board_bad_bytes = BOARD_FLAGS & SOUND_BYTE ? 1 : (uint8_t)(board_bad_bytes + 1);
            if (board_bad_bytes > BAD_BYTES)
                board_bad_bytes = BAD_BYTES;
            BOARD_FLAGS &= (uint8_t)~SOUND_BYTE;
            return;
        }
    }
    BOARD_FLAGS |= SOUND_BYTE;
    BOARD_FLAGS |= BYTE_CAME;
    if (!rx_put(&board_rx, byte)) {
        lost++;
        UCSR0B &= (uint8_t)~_BV(RXCIE0);
    }
}

ISR(USART_UDRE_vect)
{
    uint8_t tail = board_tx.tail;
    RING_ORDER();
    UDR0 = board_tx.data[tail];
    tail = (uint8_t)((tail + 1) & (TX_RING - 1));
    board_tx.tail = tail;
    if (tail == board_tx.head)
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
}

void board_send_later(void)
{
    UCSR0B &= (uint8_t)~_BV(UDRIE0);
}

void board_receive(void)
{
    ATOMICALLY { UCSR0B |= _BV(RXCIE0); }
}

uint8_t board_deaf(void)
{
    return !(UCSR0B & _BV(RXCIE0));
}

void board_send(void)
{
    ATOMICALLY
    {
        if (board_tx.head != board_tx.tail)
            UCSR0B |= _BV(UDRIE0);
    }
}

/* The main loop asks more often than 256 bytes can come. */
uint16_t board_rx_lost(void)
{
    static uint8_t seen;
    static uint16_t total;
    uint8_t fresh = (uint8_t)(lost - seen);
    seen = (uint8_t)(seen + fresh);
    total = fresh > 0xffff - total ? 0xffff : (uint16_t)(total + fresh);
    return total;
}
#else
typedef int board_line_is_not_this_one; /* a C file must not be empty */
#endif
