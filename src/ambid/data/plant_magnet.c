/* m x'' = f(x, i) - c x' + m g + d0,  u + d1 = R i + dlambda(x, i)/dt: force and flux linkage from one co-energy, of
 * position, current and voltage as they are: what counts from the operating point, with what these are there. */

static double plant_current(const struct plant_parameters *p, const double *x)
{
    return x[2] + p->current_rest - p->i_offset;
}

static void plant_magnet(const struct plant_parameters *p, const double *x, double *f, double *k_i, double *L)
{
    const double at = x[0] + p->position_rest - @x_offset@, i = plant_current(p, x);
    int side;

    *f = *k_i = 0.0;
    *L = @L_leak@ + @L_rise@ * i * i / (i * i + @i_knee@ * @i_knee@);
    for (side = 0; side < 1 + PLANT_PAIR; side++) {
        const double sd = PLANT_PAIR && side == 0 ? -1.0 : 1.0, sc = side == 1 ? -1.0 : 1.0; /* of gap and current */
        const double k = @strength@ * (1.0 - PLANT_PAIR * sd * @k_asym@);
        const double j = sc * i + PLANT_PAIR * (@i0@ + sc * @i0_asym@), r = sqrt(1.0 + @sigma@ * j * j);
        const double g = PLANT_EXPONENTIAL ? k * exp(-sd * at / @length@) : k / (@length@ + sd * at);
        const double g1 = -g / (PLANT_EXPONENTIAL ? @length@ : @length@ + sd * at);

        *f += sd * g1 * j * j / (1.0 + r);
        *k_i += sd * sc * g1 * j / r;
        *L += g / (r * r * r);
    }
}

void plant_derivative(const struct plant_parameters *p, const double *x, const double *u, const double *d, double *dx)
{
    const double i = plant_current(p, x);
    double pull, k_i, L, v = u[0] + p->voltage_rest + @v_offset@ + d[1] - @v_drop@ * tanh(i / @i_drop@);

    plant_magnet(p, x, &pull, &k_i, &L);
#if PLANT_STATES > 3
    dx[3] = @a@ * (pull - x[3]);
    pull = x[3];
#endif
    dx[0] = x[1];
    dx[1] = (pull - p->c * x[1] + d[0]) / p->m + @g@;
    dx[2] = (v - p->R * i - k_i * x[1]) / L;
}

/* A classical fourth-order step; of a rotor that lies on a stop only current and lagging force move. */
static void plant_runge_kutta(struct plant *s, const double *u, const double *d, double h, int lies)
{
    static const double part[] = {0.0, 0.5, 0.5, 1.0}, weight[] = {1.0, 2.0, 2.0, 1.0};
    double k[PLANT_STATES] = {0.0}, at[PLANT_STATES], sum[PLANT_STATES] = {0.0};
    int i, stage;

    for (stage = 0; stage < 4; stage++) {
        for (i = 0; i < PLANT_STATES; i++)
            at[i] = s->x[i] + part[stage] * h * k[i];
        plant_derivative(&s->p, at, u, d, k);
        if (lies)
            k[0] = k[1] = 0.0;
        for (i = 0; i < PLANT_STATES; i++)
            sum[i] += weight[stage] * k[i];
    }
    for (i = 0; i < PLANT_STATES; i++)
        s->x[i] += h / 6.0 * sum[i];
}

static int plant_advance(struct plant *s, const double *u, const double *d, double length)
{
    int n = PLANT_SUBSTEPS * (int)ceil(length / PLANT_PERIOD - 1e-9), touched = 0;
    double h;

    n = n < 1 ? 1 : n;
    h = length / n;
    for (; n > 0; n--) {
        const double x = s->x[0], push = x >= s->p.position_high ? 1.0 : x <= s->p.position_low ? -1.0 : 0.0;
        int lies = 0;

        if (s->x[1] == 0.0 && push != 0.0) {
            double dx[PLANT_STATES];
            plant_derivative(&s->p, s->x, u, d, dx);
            lies = push * dx[1] >= 0.0;
        }
        plant_runge_kutta(s, u, d, h, lies);
        touched |= lies ? 1 : plant_stop(s);
    }
    return touched;
}

void plant_outputs(const struct plant *s, double *y)
{
    y[0] = s->x[0];
    y[1] = s->x[2];
    y[2] = s->x[1];
}

/* The equations hold between the pole faces alone, though they give finite numbers beyond. */
static int plant_settle(struct plant *s, int touched)
{
    const double at = s->x[0] + s->p.position_rest - s->p.x_offset;

    if (!PLANT_EXPONENTIAL && (at <= -s->p.@length_name@ || (PLANT_PAIR && at >= s->p.@length_name@)))
        return PLANT_LOST;
    return touched;
}
