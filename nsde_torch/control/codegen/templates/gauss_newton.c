typedef char memory; /* between iterations there is none */

static real improve(nsde_work *w, int first, memory *m, real *cost, real *before)
{
    (void)m;
    return iteration(w, cost, !first, before);
}
