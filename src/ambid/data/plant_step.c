
/* Where it begins, with some parameters: for example &plant_identified. */
void plant_reset(struct plant *s, const struct plant_parameters *p)
{
    const struct plant_parameters own = *p; /* which may be those of s */

    memset(s, 0, sizeof *s);
    s->p = own;
    s->known = 1;
    plant_begin(&s->p, s->x);
#if PLANT_FOLLOWS
    {
        double k_i, L;
        plant_magnet(&s->p, s->x, &s->x[3], &k_i, &L);
    }
#endif
}

/* Over `length` s with inputs u, which reach the plant late, and disturbances d, which act at once; all are held. */
int plant_step(struct plant *s, const double *u, const double *d, double length)
{
    const double near = 1e-9 * PLANT_PERIOD;
    double done = 0.0, longest = 0.0, held[PLANT_INPUTS];
    int i, j, k, touched = 0;

    if (!(length > near && length < 1e6 * PLANT_PERIOD))
        return PLANT_REFUSED;
    if (memcmp(u, s->past[s->known - 1], sizeof held) != 0) {
        if (s->known == PLANT_HISTORY)
            return PLANT_REFUSED;
        s->age[s->known] = 0.0;
        memcpy(s->past[s->known++], u, sizeof held);
    }
    while (done < length) {
        double next = length;
        for (j = 0; j < PLANT_INPUTS; j++) {
            const double late = s->p.delay[j];
            for (k = s->known - 1; k > 0 && s->age[k] + done < late - near; k--)
                if (late - s->age[k] < next - near)
                    next = late - s->age[k];
            held[j] = s->past[k][j];
        }
        touched |= plant_advance(s, held, d, next - done);
        done = next;
    }
    for (j = 0; j < PLANT_INPUTS; j++)
        longest = s->p.delay[j] > longest ? s->p.delay[j] : longest;
    for (k = 0; k < s->known; k++)
        s->age[k] += length;
    for (k = 0; k + 1 < s->known && s->age[k + 1] >= longest - near; k++)
        continue; /* what all inputs have left behind */
    s->known -= k;
    memmove(s->age, s->age + k, (size_t)s->known * sizeof s->age[0]);
    memmove(s->past, s->past + k, (size_t)s->known * sizeof s->past[0]);
    touched = plant_settle(s, touched);
    for (i = 0; i < PLANT_STATES; i++)
        if (!isfinite(s->x[i]))
            return PLANT_LOST;
    return touched;
}
