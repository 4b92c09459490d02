/*
 * Excitations as the table of messages describes them. What costs time is done when one is loaded, not in the tick.
 */
#include "excitation.h"

#include "board.h"
#include "flash.h"

#define BITS_LEAST 3
#define BITS_MOST 15

/* Feedback masks of greatest length, from 3 bits on. */
static const uint16_t masks[BITS_MOST - BITS_LEAST + 1] FLASH = {0x3, 0x3, 0x5,  0x3,  0x3,   0x1d, 0x11,
                                                                 0x9, 0x5, 0x53, 0x1b, 0x443, 0x3};

static uint16_t lower(uint16_t seed, uint8_t bits)
{
    return (uint16_t)(seed & ((1u << bits) - 1));
}

uint8_t excitation_refuses(const struct msg_excitation *wanted)
{
    uint16_t length = wanted->length;
    if (wanted->kind > KIND_TABLE)
        return 2;
    if (wanted->amplitude > BOARD_PWM_TOP)
        return 3;
    if (wanted->hold == 0)
        return 4;
    if (wanted->kind == KIND_PRBS) {
        if (length < BITS_LEAST || length > BITS_MOST)
            return 5;
        if (lower(wanted->seed, (uint8_t)length) == 0)
            return 7;
    }
    if (wanted->kind == KIND_TABLE && (length < 1 || length > EXCITATION_TABLE))
        return 5;
    return 0;
}

void excitation_load(struct excitation *e, const struct msg_excitation *wanted)
{
    e->kind = wanted->kind;
    e->hold = wanted->hold;
    e->cycles = wanted->cycles;
    e->amplitude = (int16_t)wanted->amplitude;
    e->scale = ((uint32_t)wanted->amplitude * 65536u + 63u) / 127u;
    e->elements = 2;
    if (wanted->kind == KIND_PRBS) {
        e->bits = (uint8_t)wanted->length;
        e->elements = (uint16_t)((1u << e->bits) - 1);
        e->start = lower(wanted->seed, e->bits);
        e->mask = flash_u16(&masks[e->bits - BITS_LEAST]);
    } else if (wanted->kind == KIND_TABLE) {
        e->elements = wanted->length;
    }
}

void excitation_begin(struct excitation *e)
{
    e->index = 0;
    e->held = 0;
    e->cycles_left = e->cycles;
    e->shift = e->start;
    e->playing = e->kind != KIND_NONE;
}

static int16_t next_bit(struct excitation *e)
{
    uint16_t now = e->shift;
    uint8_t parity = (uint8_t)((now & e->mask) ^ ((now & e->mask) >> 8));
    parity ^= (uint8_t)(parity >> 4);
    parity ^= (uint8_t)(parity >> 2);
    parity ^= (uint8_t)(parity >> 1);
    e->shift = (uint16_t)((now >> 1) | ((uint16_t)(parity & 1) << (e->bits - 1)));
    return (now & 1) ? e->amplitude : (int16_t)-e->amplitude;
}

/* amplitude * value / 127 to the nearest count. A tie would need an amplitude of a multiple of 63.5: there is none
 * that is whole and leaves a half. */
static int16_t of_table(const struct excitation *e, int8_t value)
{
    uint8_t size = (uint8_t)(value < 0 ? -value : value);
    int16_t counts = (int16_t)((e->scale * size + 0x8000u) >> 16);
    return value < 0 ? (int16_t)-counts : counts;
}

static int16_t element(struct excitation *e, const int8_t *table)
{
    if (e->kind == KIND_PRBS)
        return next_bit(e);
    if (e->kind == KIND_TABLE)
        return of_table(e, table[e->index]);
    return e->index ? (int16_t)-e->amplitude : e->amplitude;
}

int16_t excitation_next(struct excitation *e, const int8_t *table)
{
    if (!e->playing)
        return 0;
    if (e->held == 0) {
        if (e->index == e->elements) {
            e->index = 0;
            if (e->cycles && --e->cycles_left == 0) {
                e->playing = 0;
                return 0;
            }
        }
        e->value = element(e, table);
        e->index++;
        e->held = e->hold;
    }
    e->held--;
    return e->value;
}
