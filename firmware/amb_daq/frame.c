/*
 * Encoding into the transmit ring, and decoding byte by byte.
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* it runs in each tick */
#endif
#include "frame.h"

#include "crc16.h"

/* Encoder of COBS that writes straight into the ring, behind its head: nothing is sent before the head moves on. */
struct writer {
    uint8_t *data;
    uint8_t at;   /* where the next byte goes */
    uint8_t mark; /* where the code byte of this block stands */
};

static inline void put(struct writer *w, uint8_t byte)
{
    if (byte) {
        w->data[w->at] = byte;
    } else {
        w->data[w->mark] = (uint8_t)((w->at - w->mark) & (TX_RING - 1));
        w->mark = w->at;
    }
    w->at = (uint8_t)((w->at + 1) & (TX_RING - 1));
}

uint8_t frame_put(struct tx_ring *ring, const uint8_t *body, uint8_t n, uint8_t reserve)
{
    struct writer w;
    uint16_t crc = 0;
    if (tx_free(ring) < (uint16_t)FRAME_BYTES(n) + reserve)
        return 0;
    w.data = ring->data;
    w.mark = ring->head;
    w.at = (uint8_t)((w.mark + 1) & (TX_RING - 1));
    while (n--) {
        uint8_t byte = *body++;
        crc = crc16_add(crc, byte);
        put(&w, byte);
    }
    put(&w, (uint8_t)crc);
    put(&w, (uint8_t)(crc >> 8));
    put(&w, 0); /* closes the last block; the place it takes for a next one is the frame's end */
    w.data[w.mark] = 0;
    RING_ORDER();
    ring->head = w.at;
    return 1;
}

static uint8_t sound(const struct decoder *d)
{
    uint16_t crc = 0;
    uint8_t i;
    if (d->damaged || d->left || d->length < 3)
        return 0;
    for (i = 0; i < d->length - 2; i++)
        crc = crc16_add(crc, d->body[i]);
    return crc == get_u16(d->body + d->length - 2);
}

static void keep(struct decoder *d, uint8_t byte)
{
    if (d->length < FRAME_LARGEST)
        d->body[d->length++] = byte;
    else
        d->damaged = 1;
}

uint8_t decoder_feed(struct decoder *d, uint8_t byte)
{
    uint8_t result = 0;
    if (byte == 0) {
        if (d->begun)
            result = sound(d) ? (uint8_t)(d->length - 2) : FRAME_DAMAGED;
        d->length = d->left = d->zero = d->begun = d->damaged = 0;
        return result;
    }
    d->begun = 1;
    if (d->damaged)
        return 0;
    if (d->left) {
        d->left--;
        keep(d, byte);
        return 0;
    }
    if (d->zero)
        keep(d, 0);
    d->left = (uint8_t)(byte - 1);
    d->zero = byte != 0xff;
    return 0;
}
#if (RX_RING & (RX_RING - 1)) || (TX_RING & (TX_RING - 1))
#error "a ring's size must be a power of two"
#endif
