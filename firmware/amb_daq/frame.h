/*
 * Frames on the line: COBS( body | CRC-16/XMODEM, low byte first ) 0x00, the body being code and fields of a message.
 *
 * No zero stands inside a frame, so that a receiver finds the next frame after any damage.
 */
#ifndef AMB_DAQ_FRAME_H
#define AMB_DAQ_FRAME_H

#include <stdint.h>

#include "protocol.h"
#include "ring.h"

#define BODY_LARGEST (FRAME_LARGEST - 2)
/* Bytes on the line of a body of n bytes: CRC, one overhead byte of COBS (frames are shorter than 254), the zero. */
#define FRAME_BYTES(n) ((n) + 4)
#define FRAME_DAMAGED 0xff

struct decoder {
    uint8_t length;  /* bytes decoded so far */
    uint8_t left;    /* bytes until the next block's code byte */
    uint8_t zero;    /* a zero stands between this block and the next */
    uint8_t begun;   /* something came since the last zero */
    uint8_t damaged; /* too long: nothing more of it is kept */
    uint8_t body[FRAME_LARGEST];
};

/* Puts the body of n bytes into the ring as a whole frame; 0: there is no room with `reserve` bytes kept free, and
 * nothing was put. */
uint8_t frame_put(struct tx_ring *ring, const uint8_t *body, uint8_t n, uint8_t reserve);

/* Takes one byte from the line. Returns the length of the body once a sound frame is complete, FRAME_DAMAGED at the end
 * of a damaged one, else 0. Empty frames are passed over. The body stands until the next call. */
uint8_t decoder_feed(struct decoder *decoder, uint8_t byte);

#endif
