/* Motion of the bench: the linear plant by exact matrices, the magnets by their co-energy and Runge and Kutta's method.
 *
 * m x'' = f(x, i) - c x' + m g + force,   V = R i + L(x) i' + k_i(x, i) x'
 */
#include "plant.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define FINE 200 /* ticks of the longest step of the nonlinear plant: 12.5 us */

/* ---- linear: exp([[A, B], [0, 0]] t) for every number of ticks that can occur ---------------------------------- */

#define N 5 /* x, v, i, voltage, force */

static void multiply(double out[N][N], double a[N][N], double b[N][N])
{
    double sum[N][N];
    for (int r = 0; r < N; r++)
        for (int c = 0; c < N; c++) {
            sum[r][c] = 0.0;
            for (int k = 0; k < N; k++)
                sum[r][c] += a[r][k] * b[k][c];
        }
    memcpy(out, sum, sizeof sum);
}

/* Taylor's series of a matrix made small by halving, then squared as often. */
static void exponential(double out[N][N], double rate[N][N], double seconds)
{
    double largest = 0.0;
    for (int r = 0; r < N; r++) {
        double row = 0.0;
        for (int c = 0; c < N; c++)
            row += fabs(rate[r][c] * seconds);
        largest = fmax(largest, row);
    }
    int halvings = 0;
    for (; largest > 0.125; largest *= 0.5)
        halvings++;
    double small[N][N], term[N][N];
    memset(term, 0, sizeof term);
    memset(out, 0, sizeof term);
    for (int r = 0; r < N; r++) {
        term[r][r] = out[r][r] = 1.0;
        for (int c = 0; c < N; c++)
            small[r][c] = ldexp(rate[r][c] * seconds, -halvings);
    }
    for (int order = 1; order <= 12; order++) {
        multiply(term, term, small);
        for (int r = 0; r < N; r++)
            for (int c = 0; c < N; c++) {
                term[r][c] /= order;
                out[r][c] += term[r][c];
            }
    }
    while (halvings-- > 0)
        multiply(out, out, out);
}

static void make_steps(struct plant *p)
{
    const struct plant_config *is = &p->is;
    for (int open = 0; open < 2; open++) {
        double rate[N][N] = {
            {0.0, 1.0, 0.0, 0.0, 0.0},
            {-is->k_x / is->m, -is->c / is->m, is->k_i / is->m, 0.0, 1.0 / is->m},
            {0.0, -is->k_i / is->L, -is->R / is->L, 1.0 / is->L, 0.0},
        };
        if (open)
            memset(rate[2], 0, sizeof rate[2]);
        for (int ticks = 0; ticks <= PLANT_EXACT; ticks++) {
            double full[N][N];
            exponential(full, rate, ticks / PLANT_TICK_HZ);
            memcpy(p->step[open][ticks], full, sizeof p->step[open][ticks]);
        }
    }
}

static void linear_step(struct plant *p, unsigned ticks, int open, double volts)
{
    const double *rest = p->is.rest;
    const double from[N] = {p->x - rest[0], p->v, p->i - rest[1], volts - rest[2], p->force + p->push};
    double to[3] = {rest[0], 0.0, rest[1]};
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < N; c++)
            to[r] += p->step[open][ticks][r][c] * from[c];
    p->x = to[0];
    p->v = to[1];
    p->i = to[2];
}

/* ---- magnets: W' = k_a (i0 + i)^2 / (2 (s_a - x)) + k_b (i0 - i)^2 / (2 (s_b + x)) + leakage i^2 / 2 ------------ */

struct rates {
    double x, v, i;
};

static struct rates rates_of(const struct plant *p, struct rates at, int open, double volts)
{
    const struct plant_config *is = &p->is;
    const int pair = is->kind == PLANT_DIFFERENTIAL;
    const double near_a = pair ? 1.0 / (is->gap - at.x) : 0.0;
    const double near_b = 1.0 / ((pair ? is->gap : 0.0) + at.x);
    const double flux_a = (is->bias + at.i) * near_a, flux_b = (is->bias - at.i) * near_b;
    const double pull = 0.5 * is->k * (flux_a * flux_a - flux_b * flux_b);
    const double motional = is->k * (flux_a * near_a + flux_b * near_b);
    const double inductance = is->k * (near_a + near_b) + is->leakage;
    struct rates out;
    out.x = at.v;
    out.v = (pull - is->c * at.v + p->force + p->push) / is->m + is->gravity;
    out.i = open ? 0.0 : (volts - is->R * at.i - motional * at.v) / inductance;
    return out;
}

static struct rates moved(struct rates at, struct rates by, double seconds)
{
    const struct rates out = {at.x + seconds * by.x, at.v + seconds * by.v, at.i + seconds * by.i};
    return out;
}

static void runge_kutta(struct plant *p, double h, int open, double volts)
{
    const struct rates at = {p->x, p->v, p->i};
    const struct rates a = rates_of(p, at, open, volts);
    const struct rates b = rates_of(p, moved(at, a, 0.5 * h), open, volts);
    const struct rates c = rates_of(p, moved(at, b, 0.5 * h), open, volts);
    const struct rates d = rates_of(p, moved(at, c, h), open, volts);
    p->x += h / 6.0 * (a.x + 2.0 * (b.x + c.x) + d.x);
    p->v += h / 6.0 * (a.v + 2.0 * (b.v + c.v) + d.v);
    p->i += h / 6.0 * (a.i + 2.0 * (b.i + c.i) + d.i);
}

/* ---- both ------------------------------------------------------------------------------------------------------ */

/* Without rebound, as `ambid.simulation` does it. */
static void hold_at_stops(struct plant *p)
{
    p->touching = p->x >= p->is.stop[1] ? 1 : p->x <= p->is.stop[0] ? -1 : 0;
    if (p->touching > 0) {
        p->x = p->is.stop[1];
        p->v = fmin(p->v, 0.0);
    } else if (p->touching < 0) {
        p->x = p->is.stop[0];
        p->v = fmax(p->v, 0.0);
    }
}

static double one_step(struct plant *p, unsigned ticks, enum plant_drive drive, double volts)
{
    const double before = p->i;
    int open = 0;
    if (drive == PLANT_OFF) {
        /* Through the diodes the current runs against the supply until there is none; then nothing conducts. */
        volts = p->is.diodes ? -copysign(p->is.supply, before) : 0.0;
        open = p->is.diodes && before == 0.0;
        volts = open ? 0.0 : volts;
    } else {
        volts += p->voltage;
        open = p->is.one_way && before <= 0.0 && volts <= 0.0;
    }
    if (p->is.kind == PLANT_LINEAR)
        linear_step(p, ticks, open, volts);
    else
        runge_kutta(p, ticks / PLANT_TICK_HZ, open, volts);
    if (drive == PLANT_OFF && p->is.diodes && p->i * before <= 0.0)
        p->i = 0.0;
    if (p->is.one_way && p->i < 0.0)
        p->i = 0.0;
    hold_at_stops(p);
    return volts;
}

double plant_advance(struct plant *p, unsigned ticks, enum plant_drive drive, double volts)
{
    const unsigned longest = p->is.kind == PLANT_LINEAR ? PLANT_EXACT : FINE;
    double sum = 0.0;
    for (unsigned done = 0; done < ticks;) {
        const unsigned now = ticks - done < longest ? ticks - done : longest;
        sum += now * one_step(p, now, drive, volts);
        done += now;
    }
    return ticks ? sum / ticks : volts;
}

void plant_draw(struct plant *p, unsigned ticks)
{
    const double root = sqrt(PLANT_TICK_HZ / ticks / 2.0); /* a held white noise of one-sided density 1 has this rms */
    p->force = p->is.force_noise > 0.0 ? p->is.force_noise * root * noise_normal(&p->noise) : 0.0;
    p->voltage = p->is.voltage_noise > 0.0 ? p->is.voltage_noise * root * noise_normal(&p->noise) : 0.0;
}

/* The voltage at which a table shows `quantity`; beyond its ends by its last piece. */
static double by_table(const struct sensor *s, double quantity)
{
    const int rising = s->quantity[s->points - 1] > s->quantity[0];
    int k = 0;
    while (k + 2 < s->points && (rising ? quantity > s->quantity[k + 1] : quantity < s->quantity[k + 1]))
        k++;
    const double along = (quantity - s->quantity[k]) / (s->quantity[k + 1] - s->quantity[k]);
    return s->volts[k] + along * (s->volts[k + 1] - s->volts[k]);
}

double plant_pin(struct plant *p, enum plant_sensor which)
{
    const struct sensor *s = &p->is.sensor[which];
    double x = p->x, i = p->i, v = s->offset;
    if (which == PLANT_POSITION && p->is.position_noise > 0.0)
        x += p->is.position_noise * noise_normal(&p->noise);
    if (which == PLANT_CURRENT && p->is.current_noise > 0.0)
        i += p->is.current_noise * noise_normal(&p->noise);
    if (s->points > 0)
        v = by_table(s, which == PLANT_CURRENT ? i : x);
    else
        v += s->position_gain * x + s->current_gain * i;
    if (s->noise > 0.0)
        v += s->noise * noise_normal(&p->noise);
    return v;
}

void plant_begin(struct plant *p, const struct plant_config *config, uint64_t seed)
{
    memset(p, 0, sizeof *p);
    p->is = *config;
    p->x = config->start[0];
    p->v = config->start[1];
    p->i = config->start[2];
    noise_seed(&p->noise, seed);
    if (config->kind == PLANT_LINEAR)
        make_steps(p);
    hold_at_stops(p);
}

struct plant *plant_open(const char *path, uint64_t seed)
{
    struct plant_config config;
    if (plant_read(path, &config, stderr) != 0)
        return NULL;
    struct plant *p = malloc(sizeof *p);
    if (p != NULL)
        plant_begin(p, &config, seed);
    return p;
}

void plant_close(struct plant *p) { free(p); }

void plant_get(const struct plant *p, double state[3])
{
    state[0] = p->x;
    state[1] = p->v;
    state[2] = p->i;
}

void plant_set(struct plant *p, const double state[3])
{
    p->x = state[0];
    p->v = state[1];
    p->i = state[2];
}

void plant_push(struct plant *p, double newton) { p->push = newton; }
