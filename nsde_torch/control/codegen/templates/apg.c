/* ---- accelerated projected gradient --------------------------------------------------------------------- */

static const real FACTORS[] = {@factors@};
enum { N_FACTORS = (int)(sizeof FACTORS / sizeof *FACTORS) };

/* What lasts from iteration to iteration: the plan before, the momentum's counter and the step. */
typedef struct {
    real u[K][NU], counter, size;
} memory;

/* One iteration: u, z and their cost become better ones; returns the share of the cost that may be left. */
static real improve(nsde_work *w, int first, memory *m, real *cost, real *before)
{
    if (first) {
        copy(&w->u[0][0], &m->u[0][0], N);
        m->counter = 1;
        m->size = R(@first_step@);
    }
    real *u = &w->u[0][0], *start = &w->inside[0][0], *slope = &w->gradient[0][0], *tried = &w->tried[0][0];
    real later = (1 + F(sqrt)(1 + 4 * m->counter * m->counter)) / 2, share = (m->counter - 1) / later, sum = 0;
    int best = 0;
    copy(u, start, N);
    for (int i = 0; i < N; i++) {
        u[i] = clamped(start[i] + share * (start[i] - (&m->u[0][0])[i]), LOW[i], HIGH[i]);
        (&w->step[0][0])[i] = 0;
    }
    copy(w->z0, w->z[0], NZ);
    rolled(w, w->u, w->z);
    linearise(w);
    slope_at(w, w->step, w->gradient); /* half the gradient */
    for (int s = 0; s <= N_FACTORS; s++) { /* the last is the plan as it was */
        for (int i = 0; i < N; i++)
            tried[i] = s < N_FACTORS ? clamped(u[i] - 2 * FACTORS[s] * m->size * slope[i], LOW[i], HIGH[i]) : start[i];
        copy(w->z0, w->rolled[0], NZ);
        *before = rolled(w, w->tried, w->rolled);
        if (s && !(*before < *cost || (isnan(*cost) && !isnan(*before)))) continue;
        copy(&w->rolled[0][0], &w->path[0][0], (K + 1) * NZ);
        copy(tried, &w->found[0][0], N);
        *cost = *before;
        best = s;
    }
    m->size = clamped(FACTORS[SMALLER(best, N_FACTORS - 1)] * m->size, R(1e-7), 1);
    /* the input terms alone curve the cost, which bounds what is left by the projected gradient; a loose bound */
    for (int i = 0; i < N; i++) {
        real moved = (u[i] - clamped(u[i] - 2 * m->size * slope[i], LOW[i], HIGH[i])) / m->size;
        sum += moved * moved / LARGER(4 * INPUT_WEIGHT[i % NU], R(1e-6));
    }
    m->counter = best == N_FACTORS ? 1 : later; /* nothing was better: without momentum from here */
    copy(start, &m->u[0][0], N);
    copy(&w->found[0][0], u, N);
    copy(&w->path[0][0], &w->z[0][0], (K + 1) * NZ);
    return sum / LARGER(F(fabs)(*cost), R(1e-9));
}
