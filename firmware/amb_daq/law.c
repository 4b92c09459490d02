/*
 * The state-space law: one product costs 23 cycles, a block of two states some 500. The states move on while the pulse
 * width waits for its moment (tick.c).
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* also where the Arduino IDE asks for small code: it runs in each tick */
#endif
#include "law.h"

#include "multiply.h"

#define STEP (1L << 14) /* of a state: what multiplies moves by one */
#define HALF_A_STEP (1L << 13)
#define STATES (1L << 29) /* limits of a state */
#define E_LARGEST 4095
#define SUM_LARGEST ((1L << 26) - 1)

/* value >> shift to the nearest, ties up. The processor shifts by one bit at a time, but moves whole bytes. */
static inline int32_t shifted(int32_t value, uint8_t shift)
{
    if (shift == 0)
        return value;
    if (shift > 8) {
        value >>= 8;
        shift = (uint8_t)(shift - 8);
    }
    while (--shift)
        value >>= 1;
    return (value + 1) >> 1;
}

static inline int32_t within(int32_t value, int32_t largest)
{
    if (value > largest)
        return largest;
    if (value < -largest)
        return -largest;
    return value;
}

static inline int16_t upper(int32_t z)
{
    return (int16_t)((z * 4) >> 16);
}

static inline uint16_t size(int16_t word)
{
    return word < 0 ? (uint16_t)-(uint16_t)word : (uint16_t)word;
}

static uint8_t too_large(const int16_t *words, uint8_t n)
{
    uint32_t sum = 0;
    while (n--)
        sum += size(*words++);
    return sum > LAW_ROW;
}

uint8_t law_refuses(const struct law *law)
{
    uint32_t outputs = (uint32_t)size(law->d0) + size(law->d1);
    uint8_t i;
    if (law->n == 0 || law->n > LAW_STATES || law->shift > 15)
        return 1;
    for (i = 0; i < law->n; i++) {
        const struct law_row *row = &law->rows[i];
        if (row->shift < 0 || row->shift > 15 || too_large(&row->self, 5))
            return 1;
        outputs += size(row->c);
    }
    if ((law->n & 1) && law->rows[law->n - 1].other)
        return 1;
    return outputs > LAW_ROW;
}

static uint8_t integrates(const struct law_row *row)
{
    return row->self == 0 && row->other == 0;
}

/* |h| at which c h 2^-shift is `carry`, by long division, as a product of more than 32 bits is dear. */
static int16_t holding(int32_t carry, int16_t c, uint8_t shift)
{
    uint32_t of = (uint32_t)(carry < 0 ? -carry : carry), by = size(c), h = of / by, left = of % by;
    while (shift--) {
        left *= 2;
        h *= 2;
        if (left >= by) {
            left -= by;
            h++;
        }
        if (h >= 32767)
            return 32767;
    }
    return h >= 32767 ? 32767 : (int16_t)h;
}

void law_begin(const struct law *law, struct law_state *state, int32_t carry)
{
    uint8_t i, taken = 0;
    state->next = 0;
    for (i = 0; i < law->n; i++) {
        const struct law_row *row = &law->rows[i];
        const int16_t *c = &row->c;
        state->z[i] = HALF_A_STEP;
        if (!taken && integrates(row) && row->c) {
            int16_t h = holding(carry, row->c, law->shift);
            if ((carry < 0) != (row->c < 0))
                h = (int16_t)-h;
            state->z[i] += (int32_t)h * STEP;
            state->next = multiply_add(0, &c, h);
            taken = 1;
        }
    }
    state->row = law->n;
}

int32_t law_carried(const struct law *law, const struct law_state *state)
{
    int32_t sum = 0;
    uint8_t i;
    for (i = 0; i < law->n; i++) {
        const int16_t *c = &law->rows[i].c;
        if (integrates(&law->rows[i]))
            sum = multiply_add(sum, &c, upper(state->z[i]));
    }
    return shifted(sum, law->shift);
}

uint16_t law_end(const struct law *law, struct law_state *state, int16_t current, int16_t offset, uint16_t low, uint16_t high)
{
    const int16_t *d = &law->d0;
    int32_t sum;
    int16_t wanted, duty, e;
    state->y1 = (int16_t)(current * 32);
    sum = within(shifted(multiply_add(multiply_add(state->next, &d, state->y0), &d, state->y1), law->shift), SUM_LARGEST);
    duty = wanted = (int16_t)((int16_t)((sum + 2048) * 16 >> 16) + offset);
    if (wanted > (int16_t)high)
        duty = (int16_t)high;
    else if (wanted < (int16_t)low)
        duty = (int16_t)low;
    e = (int16_t)(duty - wanted);
    state->e = e > E_LARGEST ? 8 * E_LARGEST : e < -E_LARGEST ? -8 * E_LARGEST : (int16_t)(e * 8);
    state->row = 0;
    state->next = 0;
    return (uint16_t)duty;
}

/* One row and its part of C z; returns where the next one stands. */
static const int16_t *move(const int16_t *words, struct law_state *state, int32_t *z, int16_t own, int16_t other)
{
    uint8_t shift = (uint8_t)*words++;
    int32_t sum = multiply_add(multiply_add(multiply_add(multiply_add(0, &words, own), &words, other), &words, state->y0), &words, state->y1);
    if (state->e)
        sum = multiply_add(sum, &words, state->e);
    else
        words++;
    sum = *z + shifted(sum, shift);
    if (sum >= STATES)
        sum = STATES - 1;
    else if (sum < -STATES)
        sum = -STATES;
    *z = sum;
    state->next = multiply_add(state->next, &words, upper(sum));
    return words;
}

uint8_t law_ahead(const struct law *law, struct law_state *state)
{
    uint8_t at = state->row;
    int32_t *z = &state->z[at];
    int16_t first, second;
    const int16_t *words;
    if (at >= law->n)
        return 0;
    words = &law->rows[at].shift;
    first = upper(z[0]);
    second = at + 1 < law->n ? upper(z[1]) : 0;
    words = move(words, state, z, first, second);
    if (at + 1 < law->n)
        move(words, state, z + 1, second, first);
    state->row = (uint8_t)(at + 2);
    return 1;
}
