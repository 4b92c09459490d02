/*
 * The state-space law: one product costs 23 cycles, a block of two states some 500. The states move on while the pulse
 * width waits for its moment (tick.c).
 */
#ifdef __AVR__
#pragma GCC optimize("O2") /* also where the Arduino IDE asks for small code: it runs in each tick */
#endif
#include "law.h"

#include <stddef.h>

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
    state->left = 0;
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
    state->left = law->n;
    state->words = &law->rows[0].shift;
    state->at = state->z;
    state->next = 0;
    return (uint16_t)duty;
}

void law_settled(const struct law *law, struct law_state *state)
{
    uint8_t i;
    state->next = 0;
    for (i = 0; i < law->n; i++) {
        const int16_t *c = &law->rows[i].c;
        if (integrates(&law->rows[i]))
            state->z[i] = HALF_A_STEP;
        state->next = multiply_add(state->next, &c, upper(state->z[i]));
    }
}

/* One row of the next states and its part of C z; returns where the next row stands. It is half of all work, and takes some
 * 270 cycles as it stands here; as the compiler makes it from what follows below, 400. */
const int16_t *law_move(const int16_t *words, struct law_state *state, int32_t *z, int16_t own, int16_t other);

#ifdef __AVR__
typedef char law_state_is_laid_out_so[offsetof(struct law_state, next) == 24 && offsetof(struct law_state, e) == 32 ? 1 : -1];

/* r25..r22 += the next word * b */
#define ADD_WORD(low, high)                                                                                            \
    "ld r20, X+\n\tld r21, X+\n\t"                                                                                     \
    "muls r21, " high "\n\tadd r24, r0\n\tadc r25, r1\n\t"                                                             \
    "mul r20, " low "\n\tadd r22, r0\n\tadc r23, r1\n\tadc r24, r2\n\tadc r25, r2\n\t"                                 \
    "mulsu r21, " low "\n\tsbc r25, r2\n\tadd r23, r0\n\tadc r24, r1\n\tadc r25, r2\n\t"                               \
    "mulsu " high ", r20\n\tsbc r25, r2\n\tadd r23, r0\n\tadc r24, r1\n\tadc r25, r2\n\t"
#define HALVE "asr r25\n\tror r24\n\tror r23\n\tror r22\n\t"

/* X: words, Y: state, Z: z; r19:r18 own, r17:r16 other, r2 zero, r3 shift. */
__asm__(".text\n"
        ".global law_move\n"
        ".type law_move, @function\n"
        "law_move:\n\t"
        "push r2\n\tpush r3\n\tpush r28\n\tpush r29\n\t"
        "movw r26, r24\n\tmovw r28, r22\n\tmovw r30, r20\n\t"
        "clr r2\n\tclr r22\n\tclr r23\n\tmovw r24, r22\n\t"
        "ld r3, X+\n\tadiw r26, 1\n\t"
        ADD_WORD("r18", "r19")
        ADD_WORD("r16", "r17")
        "ldd r18, Y+28\n\tldd r19, Y+29\n\t"
        ADD_WORD("r18", "r19")
        "ldd r18, Y+30\n\tldd r19, Y+31\n\t"
        ADD_WORD("r18", "r19")
        "ldd r18, Y+32\n\tldd r19, Y+33\n\t"
        "mov r20, r18\n\tor r20, r19\n\tbreq 1f\n\t"
        ADD_WORD("r18", "r19")
        "rjmp 2f\n"
        "1:\tadiw r26, 2\n"
        "2:\tclc\n\t" /* the last bit shifted out stays in the carry: it rounds */
        "sbrs r3, 3\n\trjmp 3f\n\t"
        "lsl r22\n\tmov r22, r23\n\tmov r23, r24\n\tmov r24, r25\n\tclr r25\n\tsbrc r24, 7\n\tdec r25\n"
        "3:\tsbrs r3, 2\n\trjmp 4f\n\t" HALVE HALVE HALVE HALVE
        "4:\tsbrs r3, 1\n\trjmp 5f\n\t" HALVE HALVE
        "5:\tsbrs r3, 0\n\trjmp 6f\n\t" HALVE
        "6:\tadc r22, r2\n\tadc r23, r2\n\tadc r24, r2\n\tadc r25, r2\n\t"
        "ld r18, Z\n\tldd r19, Z+1\n\tldd r20, Z+2\n\tldd r21, Z+3\n\t"
        "add r22, r18\n\tadc r23, r19\n\tadc r24, r20\n\tadc r25, r21\n\t"
        "mov r18, r25\n\tsubi r18, 0xe0\n\tandi r18, 0xc0\n\tbreq 8f\n\t"
        "sbrc r25, 7\n\trjmp 7f\n\t"
        "ldi r25, 0x1f\n\tldi r24, 0xff\n\tldi r23, 0xff\n\tldi r22, 0xff\n\trjmp 8f\n"
        "7:\tldi r25, 0xe0\n\tclr r24\n\tclr r23\n\tclr r22\n"
        "8:\tst Z, r22\n\tstd Z+1, r23\n\tstd Z+2, r24\n\tstd Z+3, r25\n\t"
        "lsl r23\n\trol r24\n\trol r25\n\tlsl r23\n\trol r24\n\trol r25\n\tmovw r18, r24\n\t"
        "ldd r22, Y+24\n\tldd r23, Y+25\n\tldd r24, Y+26\n\tldd r25, Y+27\n\t"
        ADD_WORD("r18", "r19")
        "std Y+24, r22\n\tstd Y+25, r23\n\tstd Y+26, r24\n\tstd Y+27, r25\n\t"
        "clr r1\n\tmovw r24, r26\n\t"
        "pop r29\n\tpop r28\n\tpop r3\n\tpop r2\n\tret\n\t"
        ".size law_move, .-law_move\n");
#else
const int16_t *law_move(const int16_t *words, struct law_state *state, int32_t *z, int16_t own, int16_t other)
{
    uint8_t shift = (uint8_t)*words++;
    int32_t sum = multiply_add(0, &words, own);
    sum = multiply_add(sum, &words, other);
    sum = multiply_add(sum, &words, state->y0);
    sum = multiply_add(sum, &words, state->y1);
    sum = multiply_add(sum, &words, state->e);
    sum = *z + shifted(sum, shift);
    if (sum >= STATES)
        sum = STATES - 1;
    else if (sum < -STATES)
        sum = -STATES;
    *z = sum;
    state->next = multiply_add(state->next, &words, upper(sum));
    return words;
}
#endif

uint8_t law_ahead(struct law_state *state)
{
    uint8_t left = state->left;
    int32_t *z = state->at;
    int16_t first, second;
    const int16_t *words;
    if (!left)
        return 0;
    first = upper(z[0]);
    second = left > 1 ? upper(z[1]) : 0;
    words = law_move(state->words, state, z++, first, second);
    if (left > 1)
        words = law_move(words, state, z++, second, first);
    state->words = words;
    state->at = z;
    state->left = left > 2 ? (uint8_t)(left - 2) : 0;
    return 1;
}
