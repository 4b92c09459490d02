/*
 * Products of 16 bits by 16 as the processor makes them best: the compiler calls a function for each, and moves registers.
 */
#ifndef AMB_DAQ_MULTIPLY_H
#define AMB_DAQ_MULTIPLY_H

#include <stdint.h>

/* a * b */
static inline int32_t multiply(uint16_t a, int16_t b)
{
#ifdef __AVR__
    uint8_t zero;
    int32_t product;
    __asm__("clr %[z]\n\t"
            "mulsu %B[b], %B[a]\n\t"
            "movw %C[p], r0\n\t"
            "mul %A[a], %A[b]\n\t"
            "movw %A[p], r0\n\t"
            "mul %B[a], %A[b]\n\t"
            "add %B[p], r0\n\t"
            "adc %C[p], r1\n\t"
            "adc %D[p], %[z]\n\t"
            "mulsu %B[b], %A[a]\n\t"
            "sbc %D[p], %[z]\n\t"
            "add %B[p], r0\n\t"
            "adc %C[p], r1\n\t"
            "adc %D[p], %[z]\n\t"
            "clr r1\n\t"
            : [p] "=&r"(product), [z] "=&r"(zero)
            : [a] "a"(a), [b] "a"(b)
            : "r0");
    return product;
#else
    return (int32_t)a * b;
#endif
}

/* sum + the next word * b, which must fit 32 bits */
static inline int32_t multiply_add(int32_t sum, const int16_t **words, int16_t b)
{
#ifdef __AVR__
    uint8_t zero;
    int16_t a;
    __asm__("ld %A[a], %a[p]+\n\t"
            "ld %B[a], %a[p]+\n\t"
            "clr %[z]\n\t"
            "muls %B[a], %B[b]\n\t"
            "add %C[s], r0\n\t"
            "adc %D[s], r1\n\t"
            "mul %A[a], %A[b]\n\t"
            "add %A[s], r0\n\t"
            "adc %B[s], r1\n\t"
            "adc %C[s], %[z]\n\t"
            "adc %D[s], %[z]\n\t"
            "mulsu %B[a], %A[b]\n\t"
            "sbc %D[s], %[z]\n\t"
            "add %B[s], r0\n\t"
            "adc %C[s], r1\n\t"
            "adc %D[s], %[z]\n\t"
            "mulsu %B[b], %A[a]\n\t"
            "sbc %D[s], %[z]\n\t"
            "add %B[s], r0\n\t"
            "adc %C[s], r1\n\t"
            "adc %D[s], %[z]\n\t"
            "clr r1\n\t"
            : [s] "+r"(sum), [z] "=&r"(zero), [a] "=&a"(a), [p] "+e"(*words)
            : [b] "a"(b), "m"(*(const int16_t(*)[2]) * words)
            : "r0");
    return sum;
#else
    return sum + (int32_t) * (*words)++ * b;
#endif
}

#endif
