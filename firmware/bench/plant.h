/* The bench in numbers: coil, magnet, rotor, stops, and the voltages that its sensors show.
 *
 * Nothing here knows of the emulator, so that the same file is compiled natively and checked against the package's own
 * models. Time is counted in ticks of the controller's clock, because all switching happens on them. */
#ifndef AMB_BENCH_PLANT_H
#define AMB_BENCH_PLANT_H

#include <stdint.h>
#include <stdio.h>

#include "noise.h"

#define PLANT_TICK_HZ 16000000.0
#define PLANT_EXACT 800 /* ticks of the longest exact step of the linear plant: one period of the pulse width modulation */
#define PLANT_POINTS 256

enum plant_kind { PLANT_LINEAR, PLANT_DIFFERENTIAL, PLANT_SINGLE, PLANT_NO_KIND };
enum plant_sensor { PLANT_POSITION, PLANT_CURRENT, PLANT_THIRD, PLANT_SENSORS };
enum plant_drive { PLANT_DRIVEN, PLANT_OFF };

/* Volts at a pin = position_gain x + current_gain i + offset, or by a table of points (volts, quantity). */
struct sensor {
    double position_gain, current_gain, offset; /* V/m, V/A, V */
    double noise;                                /* rms, V */
    int points;
    double volts[PLANT_POINTS], quantity[PLANT_POINTS];
};

struct plant_config {
    enum plant_kind kind;
    double m, c, R, gravity;             /* kg, N s/m, ohm, m/s^2 along +x */
    double k_x, k_i, L;                  /* linear: N/m, N/A, H */
    double rest[3];                      /* linear: position m, current A, voltage V about which it holds */
    double k, gap, bias, leakage;        /* magnets: N m^2/A^2, m, A, H */
    double stop[2];                      /* m */
    double start[3];                     /* position m, velocity m/s, current A */
    double high, low, supply;            /* power stage: coil voltage at either level of its input, V; supply, V */
    int diodes, averaged, one_way;       /* off: diodes or short; pulse width averaged; current cannot go negative */
    double force_noise, voltage_noise;   /* one-sided densities, N/sqrt(Hz) and V/sqrt(Hz) */
    double position_noise, current_noise; /* rms at a conversion, m and A */
    struct sensor sensor[PLANT_SENSORS];
};

struct plant {
    struct plant_config is;
    double x, v, i;          /* m, m/s, A */
    double push;             /* force from outside, N */
    double force, voltage;   /* noise of this period, N and V */
    int touching;            /* -1 lower stop, 1 upper stop, 0 free */
    struct noise noise;
    double step[2][PLANT_EXACT + 1][3][5]; /* linear: coil driven, coil open; by ticks; rows of x, v, i */
};

/* Read a plant file. Returns 0, or -1 after one line on `complaints`. */
int plant_read(const char *path, struct plant_config *config, FILE *complaints);

void plant_begin(struct plant *p, const struct plant_config *config, uint64_t seed);

/* Carry the bench over `ticks`. Returns the mean voltage at the coil, V. */
double plant_advance(struct plant *p, unsigned ticks, enum plant_drive drive, double volts);

/* New values of the noise that is held for `ticks`. */
void plant_draw(struct plant *p, unsigned ticks);

/* Voltage at the pin of a sensor now, with its noise, V. */
double plant_pin(struct plant *p, enum plant_sensor which);

/* For programs that do not know the structure. */
struct plant *plant_open(const char *path, uint64_t seed);
void plant_close(struct plant *p);
void plant_get(const struct plant *p, double state[3]);
void plant_set(struct plant *p, const double state[3]);
void plant_push(struct plant *p, double newton);

#endif
