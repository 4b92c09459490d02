/*
 * Rings of bytes with one writer and one reader, of which either may be an interrupt.
 *
 * Indices are single bytes, so that they are read and written whole. The writer alone moves `head`, the reader alone
 * moves `tail`; a ring of N bytes holds N - 1.
 */
#ifndef AMB_DAQ_RING_H
#define AMB_DAQ_RING_H

#include <stdint.h>

/* What was read or written before it is, before what comes after it: the compiler may move plain data across an index. */
#define RING_ORDER() __asm__ volatile("" ::: "memory")

#define TX_RING 128
#define RX_RING 128

struct tx_ring {
    volatile uint8_t head, tail;
    uint8_t data[TX_RING];
};

struct rx_ring {
    volatile uint8_t head, tail;
    uint8_t data[RX_RING];
};

static inline uint8_t tx_free(const struct tx_ring *ring)
{
    return (uint8_t)((ring->tail - ring->head - 1) & (TX_RING - 1));
}

/* Puts a received byte in; 0: there is no room. */
static inline uint8_t rx_put(struct rx_ring *ring, uint8_t byte)
{
    uint8_t head = ring->head, next = (uint8_t)((head + 1) & (RX_RING - 1));
    if (next == ring->tail)
        return 0;
    ring->data[head] = byte;
    RING_ORDER();
    ring->head = next;
    return 1;
}

static inline uint8_t rx_waiting(const struct rx_ring *ring)
{
    return ring->head != ring->tail;
}

/* Takes the oldest byte; only while rx_waiting. */
static inline uint8_t rx_take(struct rx_ring *ring)
{
    uint8_t tail = ring->tail, byte;
    RING_ORDER(); /* rx_waiting has seen the head that was moved behind this byte */
    byte = ring->data[tail];
    RING_ORDER();
    ring->tail = (uint8_t)((tail + 1) & (RX_RING - 1));
    return byte;
}

#endif
