/* Repeatable random numbers: the same seed gives the same bench. */
#ifndef AMB_BENCH_NOISE_H
#define AMB_BENCH_NOISE_H

#include <stdint.h>

struct noise {
    uint64_t word[4];
    double spare; /* second number of a Box-Muller pair */
    int has_spare;
};

void noise_seed(struct noise *n, uint64_t seed);
uint64_t noise_bits(struct noise *n);   /* 64 uniform bits */
double noise_uniform(struct noise *n);  /* in [0, 1) */
double noise_normal(struct noise *n);   /* mean 0, standard deviation 1 */

#endif
