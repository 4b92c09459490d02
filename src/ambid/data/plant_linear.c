/* x' = A x + B w, w = (inputs, disturbances), from the operating point; its step is exact for inputs that are held. */

#define PLANT_COLUMNS (PLANT_INPUTS + PLANT_DISTURBANCES)

static void plant_acting(const double *u, const double *d, double *w)
{
    memcpy(w, u, PLANT_INPUTS * sizeof *w);
    memcpy(w + PLANT_INPUTS, d, PLANT_DISTURBANCES * sizeof *w);
}

void plant_derivative(const struct plant_parameters *p, const double *x, const double *u, const double *d, double *dx)
{
    double A[PLANT_STATES][PLANT_STATES] = {{0.0}}, B[PLANT_STATES][PLANT_COLUMNS] = {{0.0}};
    double w[PLANT_COLUMNS];
    int i, j;

    plant_matrices(p, A, B);
    plant_acting(u, d, w);
    for (i = 0; i < PLANT_STATES; i++) {
        dx[i] = 0.0;
        for (j = 0; j < PLANT_STATES; j++)
            dx[i] += A[i][j] * x[j];
        for (j = 0; j < PLANT_COLUMNS; j++)
            dx[i] += B[i][j] * w[j];
    }
}

/* P = exp(A t) - 1 and G = (integral of exp(A s) ds from 0 to t) B, by a series over a part of t that is doubled. */
static void plant_discretise(const struct plant_parameters *p, double t, double P[PLANT_STATES][PLANT_STATES],
                             double G[PLANT_STATES][PLANT_COLUMNS])
{
    double A[PLANT_STATES][PLANT_STATES] = {{0.0}}, B[PLANT_STATES][PLANT_COLUMNS] = {{0.0}};
    double S[PLANT_STATES][PLANT_STATES], more[PLANT_STATES][PLANT_STATES], grown[PLANT_STATES][PLANT_COLUMNS];
    double norm = 0.0;
    int i, j, k, order, doublings;

    plant_matrices(p, A, B);
    for (j = 0; j < PLANT_STATES; j++) {
        double sum = 0.0;
        for (i = 0; i < PLANT_STATES; i++)
            sum += fabs(A[i][j]);
        norm = sum > norm ? sum : norm;
    }
    norm *= t;
    for (doublings = 0; norm > 0.5 && doublings < 1100; doublings++) {
        norm *= 0.5;
        t *= 0.5;
    }
    for (i = 0; i < PLANT_STATES; i++)
        for (j = 0; j < PLANT_STATES; j++)
            S[i][j] = i == j;
    for (order = 14; order > 0; order--) { /* S = 1 + A t/2 (1 + A t/3 (...)) */
        for (i = 0; i < PLANT_STATES; i++)
            for (j = 0; j < PLANT_STATES; j++) {
                double sum = 0.0;
                for (k = 0; k < PLANT_STATES; k++)
                    sum += A[i][k] * S[k][j];
                more[i][j] = (i == j) + sum * t / (order + 1);
            }
        memcpy(S, more, sizeof S);
    }
    for (i = 0; i < PLANT_STATES; i++) {
        for (j = 0; j < PLANT_STATES; j++) {
            P[i][j] = 0.0;
            for (k = 0; k < PLANT_STATES; k++)
                P[i][j] += A[i][k] * S[k][j] * t;
        }
        for (j = 0; j < PLANT_COLUMNS; j++) {
            G[i][j] = 0.0;
            for (k = 0; k < PLANT_STATES; k++)
                G[i][j] += S[i][k] * B[k][j] * t;
        }
    }
    for (; doublings > 0; doublings--) {
        for (i = 0; i < PLANT_STATES; i++) {
            for (j = 0; j < PLANT_STATES; j++) {
                more[i][j] = 2.0 * P[i][j];
                for (k = 0; k < PLANT_STATES; k++)
                    more[i][j] += P[i][k] * P[k][j];
            }
            for (j = 0; j < PLANT_COLUMNS; j++) {
                grown[i][j] = 2.0 * G[i][j];
                for (k = 0; k < PLANT_STATES; k++)
                    grown[i][j] += P[i][k] * G[k][j];
            }
        }
        memcpy(P, more, sizeof more);
        memcpy(G, grown, sizeof grown);
    }
}

/* The matrices over a time, kept for the times that came last: there are few of them while the steps are equal. */
static const struct plant_transition *plant_over(struct plant *s, double t)
{
    struct plant_transition *found = &s->kept[s->oldest];
    int k;

    for (k = 0; k < PLANT_KEPT; k++)
        if (s->kept[k].length == t && memcmp(&s->kept[k].p, &s->p, sizeof s->p) == 0)
            return &s->kept[k];
    s->oldest = (s->oldest + 1) % PLANT_KEPT;
    found->length = t;
    found->p = s->p;
    plant_discretise(&s->p, t, found->P, found->G);
    return found;
}

static int plant_advance(struct plant *s, const double *u, const double *d, double length)
{
    const struct plant_transition *over = plant_over(s, length);
    double from[PLANT_STATES], w[PLANT_COLUMNS];
    int i, j;

    memcpy(from, s->x, sizeof from);
    plant_acting(u, d, w);
    for (i = 0; i < PLANT_STATES; i++) {
        for (j = 0; j < PLANT_STATES; j++)
            s->x[i] += over->P[i][j] * from[j];
        for (j = 0; j < PLANT_COLUMNS; j++)
            s->x[i] += over->G[i][j] * w[j];
    }
    return 0;
}

void plant_outputs(const struct plant *s, double *y)
{
    int i, j;

    for (i = 0; i < PLANT_OUTPUTS; i++) {
        y[i] = 0.0;
        for (j = 0; j < PLANT_STATES; j++)
            y[i] += plant_C[i][j] * s->x[j];
    }
}

static int plant_settle(struct plant *s, int touched)
{
    return plant_stop(s) | touched;
}
