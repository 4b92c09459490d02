/* xoshiro256++ (Blackman and Vigna 2019), filled by splitmix64; normal numbers by Box and Muller's transform. */
#include "noise.h"

#include <math.h>

static uint64_t turned_left(uint64_t x, int by) { return (x << by) | (x >> (64 - by)); }

void noise_seed(struct noise *n, uint64_t seed)
{
    for (int k = 0; k < 4; k++) {
        seed += UINT64_C(0x9e3779b97f4a7c15);
        uint64_t z = seed;
        z = (z ^ (z >> 30)) * UINT64_C(0xbf58476d1ce4e5b9);
        z = (z ^ (z >> 27)) * UINT64_C(0x94d049bb133111eb);
        n->word[k] = z ^ (z >> 31);
    }
    n->has_spare = 0;
}

uint64_t noise_bits(struct noise *n)
{
    uint64_t *s = n->word;
    const uint64_t out = turned_left(s[0] + s[3], 23) + s[0];
    const uint64_t shifted = s[1] << 17;
    s[2] ^= s[0];
    s[3] ^= s[1];
    s[1] ^= s[2];
    s[0] ^= s[3];
    s[2] ^= shifted;
    s[3] = turned_left(s[3], 45);
    return out;
}

double noise_uniform(struct noise *n) { return (double)(noise_bits(n) >> 11) * 0x1p-53; }

double noise_normal(struct noise *n)
{
    if (n->has_spare) {
        n->has_spare = 0;
        return n->spare;
    }
    const double radius = sqrt(-2.0 * log(1.0 - noise_uniform(n)));
    const double angle = 2.0 * 3.14159265358979323846 * noise_uniform(n);
    n->spare = radius * sin(angle);
    n->has_spare = 1;
    return radius * cos(angle);
}
