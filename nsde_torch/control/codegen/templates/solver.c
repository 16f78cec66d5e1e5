/* One iteration linearises all steps about inputs u and states z, which need not fit each other,

       dz' = A dz + B du + gap,        cost = sum |r + J (A dz + B du)|^2 + input terms,    low - u <= du <= high - u

   and finds du by primal-dual active sets (Hintermueller, Ito, Kunisch, SIAM J. Optim. 13, 2003). Which inputs are held
   at a bound follows from the slope over the diagonal of the condensed Hessian; the others solve the linear-quadratic
   problem that is left, by Riccati's recursion. Shares of du are rolled out, and the cheapest is kept. */

enum {
    K = NSDE_STEPS, N = K * NU,
    NR = NSDE_ROWS,     /* states of the recursion: with a weight on changes of the inputs, the inputs before too */
    LD = NSDE_STRIDE,   /* their number, rounded up for vector instructions */
};

static const real LOW[N] = {@low@}, HIGH[N] = {@high@}; /* of every step: loops over a plan take them in turn */
static const real INPUT_WEIGHT[NU] = {@input_weight@}, INPUT_CENTRE[NU] = {@input_centre@};
static const real RATE_WEIGHT = R(@rate_weight@), LEFT = R(@left@);
static const real SHARES[] = {@shares@};
enum { CHANGES = @changes@, N_SHARES = (int)(sizeof SHARES / sizeof *SHARES) };

/* ---- the model, generated ------------------------------------------------------------------------------- */

@MODEL@
/* ---- the problem ---------------------------------------------------------------------------------------- */

static real input_cost(real (*u)[NU], const real *last)
{
    real sum = 0;
    for (int k = 0; k < K; k++)
        for (int i = 0; i < NU; i++) {
            real centred = u[k][i] - INPUT_CENTRE[i], change = u[k][i] - (k ? u[k - 1][i] : last[i]);
            sum += INPUT_WEIGHT[i] * centred * centred + RATE_WEIGHT * change * change;
        }
    return sum;
}

/* States that inputs lead to from z[0], and what they cost. */
static real rolled(const nsde_work *w, real (*u)[NU], real (*z)[NZ])
{
    real sum = 0;
    for (int k = 0; k < K; k++) {
        advance(z[k], u[k], w->d, z[k + 1]);
        sum += square(z[k + 1], w->ref[k]);
    }
    return sum + input_cost(u, w->last);
}

/* Slopes of all steps and of their costs, about u and z. */
static void linearise(nsde_work *w)
{
    real after[NZ];
    for (int k = 0; k < K; k++) {
        step_slopes(w->z[k], w->u[k], w->d, w->a[k], w->b[k], after);
        w->square[k] = cost_slopes(after, w->ref[k], w->q[k], w->g[k]);
        for (int i = 0; i < NZ; i++) w->gap[k][i] = after[i] - w->z[k + 1][i];
    }
}

static real change_at(const nsde_work *w, int k, int i) { return w->u[k][i] - (k ? w->u[k - 1][i] : w->last[i]); }

/* Half the gradient of the quadratic at du (K, NU), by a pass forward and one back; returns |r + J e|^2 there. */
static real slope_at(nsde_work *w, real (*du)[NU], real (*slope)[NU])
{
    real dz[NZ], e[NZ], sum = 0;
    for (int i = 0; i < NZ; i++) dz[i] = w->z0[i] - w->z[0][i];
    for (int k = 0; k < K; k++) {
        forward(w->a[k], w->b[k], dz, du[k], e);
        times_q(w->q[k], e, w->s[k]);
        sum += w->square[k];
        for (int i = 0; i < NX; i++) {
            sum += e[i] * (w->s[k][i] + 2 * w->g[k][i]);
            w->s[k][i] += w->g[k][i];
        }
        for (int i = 0; i < NZ; i++) dz[i] = e[i] + w->gap[k][i];
    }
    real l[NR] = {0}, back[NZ];
    for (int k = K - 1; k >= 0; k--) {
        for (int i = 0; i < NX; i++) l[i] += w->s[k][i];
        back_b(w->b[k], l, slope[k]);
        back_a(w->a[k], l, back);
        copy(back, l, NZ);
        for (int i = 0; i < NU; i++) {
            real now = change_at(w, k, i) + du[k][i] - (k ? du[k - 1][i] : 0);
            real later = k < K - 1 ? change_at(w, k + 1, i) + du[k + 1][i] - du[k][i] : 0;
            slope[k][i] += INPUT_WEIGHT[i] * (w->u[k][i] + du[k][i] - INPUT_CENTRE[i]) + RATE_WEIGHT * (now - later);
        }
    }
    return sum;
}

static void mirror(real (*m)[LD])
{
    for (int i = 0; i < NR; i++)
        for (int j = 0; j < i; j++) m[j][i] = m[i][j];
}

/* Diagonal of the condensed Hessian: what each input alone costs, all others as they are. */
static void diagonal(nsde_work *w)
{
    real m[NR][LD] = {{0}}, s[NR][LD], by_input[NU][LD], own[NU][NU];
    for (int k = K - 1; k >= 0; k--) {
        add_q(w->q[k], m);
        b_times(w->b[k], m, by_input);
        times_b(by_input, w->b[k], own);
        for (int i = 0; i < NU; i++) w->scale[k][i] = own[i][i] + INPUT_WEIGHT[i] + RATE_WEIGHT * (k < K - 1 ? 2 : 1);
        a_times(w->a[k], m, s);
        times_a(s, w->a[k], m);
        mirror(m);
    }
}

/* ---- the quadratic program ------------------------------------------------------------------------------ */

/* y -= f x, of rows of a table. */
static void take(real f, const real *restrict x, real *restrict y)
{
    for (int j = 0; j < LD; j++) y[j] -= f * x[j];
}

/* One step of the recursion: cost to go before step k from that after it, with the held inputs at their bounds. */
static void recursion(nsde_work *w, int k)
{
    real n[NR][LD], s[NR][LD], by_input[NU][LD], hux[NU][LD] = {{0}}, huu[NU][NU], hu[NU], hx[NR], v[NR];
    for (int i = 0; i < NR; i++) {
        v[i] = w->pv[k + 1][i];
        for (int j = 0; j < NZ; j++) v[i] += w->p[k + 1][i][j] * w->gap[k][j];
        copy(w->p[k + 1][i], n[i], LD);
    }
    for (int i = 0; i < NX; i++) v[i] += w->g[k][i];
    add_q(w->q[k], n);
    a_times(w->a[k], n, s);
    b_times(w->b[k], n, by_input);
    times_a(s, w->a[k], w->p[k]);
    inputs_times_a(by_input, w->a[k], hux);
    times_b(by_input, w->b[k], huu);
    back_a(w->a[k], v, hx);
    back_b(w->b[k], v, hu);
    for (int i = 0; i < NU; i++) {
        huu[i][i] += INPUT_WEIGHT[i] + RATE_WEIGHT;
        hu[i] += INPUT_WEIGHT[i] * (w->u[k][i] - INPUT_CENTRE[i]) + RATE_WEIGHT * change_at(w, k, i);
    }
#if NSDE_ROWS > NSDE_NZ
    for (int i = 0; i < NU; i++) {
        hux[i][NZ + i] -= RATE_WEIGHT;
        w->p[k][NZ + i][NZ + i] += RATE_WEIGHT;
        hx[NZ + i] = -RATE_WEIGHT * change_at(w, k, i);
    }
#endif
    for (int i = 0; i < NU; i++) {
        real held = w->held[k][i] < 0 ? LOW[i] - w->u[k][i] : w->held[k][i] > 0 ? HIGH[i] - w->u[k][i] : 0;
        w->feed[k][i] = -held;
        if (held == 0) continue;
        for (int j = 0; j < NU; j++) hu[j] += huu[j][i] * held;
        for (int j = 0; j < NR; j++) hx[j] += hux[i][j] * held;
    }
    /* Cholesky's factor of the free part, and what it makes of the rest; held inputs are rows of their own */
    for (int i = 0; i < NU; i++) {
        if (w->held[k][i]) {
            for (int j = 0; j < NU; j++) huu[i][j] = huu[j][i] = 0;
            for (int j = 0; j < LD; j++) hux[i][j] = 0;
            huu[i][i] = 1;
            hu[i] = 0;
        }
    }
    for (int i = 0; i < NU; i++) {
        for (int l = 0; l <= i; l++) {
            for (int m = 0; m < l; m++) huu[i][l] -= huu[i][m] * huu[l][m];
            huu[i][l] = l < i ? huu[i][l] * huu[l][l] : 1 / F(sqrt)(huu[i][i]);
        }
        for (int l = 0; l < i; l++) {
            take(huu[i][l], hux[l], hux[i]);
            hu[i] -= huu[i][l] * hu[l];
        }
        for (int j = 0; j < LD; j++) hux[i][j] *= huu[i][i];
        hu[i] *= huu[i][i];
    }
    for (int i = 0; i < NR; i++) {
        w->pv[k][i] = hx[i];
        for (int l = 0; l < NU; l++) w->pv[k][i] -= hux[l][i] * hu[l];
    }
    less_square(hux, w->p[k]);
    mirror(w->p[k]);
    for (int i = NU - 1; i >= 0; i--) {
        for (int l = i + 1; l < NU; l++) {
            take(huu[l][i], hux[l], hux[i]);
            hu[i] -= huu[l][i] * hu[l];
        }
        for (int j = 0; j < LD; j++) w->gain[k][i][j] = hux[i][j] *= huu[i][i];
        w->feed[k][i] += hu[i] *= huu[i][i];
    }
}

/* The step that the free inputs make with the held ones at their bounds; `from` is the last step whose held inputs
   are others than those of the recursion before. */
static void newton(nsde_work *w, int from, real (*step)[NU])
{
    for (int k = from; k >= 0; k--) recursion(w, k);
    real dz[NR] = {0}, e[NZ];
    for (int i = 0; i < NZ; i++) dz[i] = w->z0[i] - w->z[0][i];
    for (int k = 0; k < K; k++) {
        for (int i = 0; i < NU; i++) {
            step[k][i] = -w->feed[k][i];
            for (int j = 0; j < NR; j++) step[k][i] -= w->gain[k][i][j] * dz[j];
        }
        forward(w->a[k], w->b[k], dz, step[k], e);
        for (int i = 0; i < NZ; i++) dz[i] = e[i] + w->gap[k][i];
        for (int i = NZ; i < NR; i++) dz[i] = step[k][i - NZ];
    }
}

/* The best step on the box that was found, in w->best, and what the quadratic saves by it; `solved` says whether a
   better one could add next to nothing. */
static real box_step(nsde_work *w, int *solved)
{
    real *u = &w->u[0][0], *g = &w->gradient[0][0], *scale = &w->scale[0][0], *best = &w->best[0][0];
    real *step = &w->step[0][0], *slope = &w->slope[0][0], *inside = &w->inside[0][0], *tangent = &w->tangent[0][0];
    signed char *held = &w->held[0][0];
    for (int i = 0; i < N; i++) {
        step[i] = 0;
        held[i] = 2; /* none of those that there are: the first recursion goes over all steps */
    }
    real along = 0, curve = 0, least, cost = slope_at(w, w->step, w->gradient) + input_cost(w->u, w->last);
    diagonal(w);
    /* along the scaled gradient, as far as the quadratic falls: poor, but never worse than no step */
    for (int i = 0; i < N; i++) best[i] = clamped(-g[i] / scale[i], LOW[i] - u[i], HIGH[i] - u[i]);
    slope_at(w, w->best, w->slope);
    for (int i = 0; i < N; i++) {
        along += g[i] * best[i];
        curve += best[i] * (slope[i] - g[i]);
    }
    real share = clamped(-along / LARGER(curve, R(1e-12)), 0, 1);
    for (int i = 0; i < N; i++) best[i] *= share;
    least = share * (share * curve + 2 * along);
    copy(g, slope, N);
    for (int change = 0; change < CHANGES; change++) {
        int from = -1, outside = 0;
        real value = 0, left = 0;
        for (int i = 0; i < N; i++) {
            real aim = step[i] - slope[i] / scale[i];
            signed char now = (signed char)(aim < LOW[i] - u[i] ? -1 : aim > HIGH[i] - u[i] ? 1 : 0);
            if (now != held[i]) from = i / NU;
            held[i] = now;
        }
        newton(w, from, w->step);
        slope_at(w, w->step, w->slope);
        for (int i = 0; i < N; i++) {
            inside[i] = clamped(step[i], LOW[i] - u[i], HIGH[i] - u[i]);
            outside |= inside[i] != step[i];
        }
        if (outside)
            slope_at(w, w->inside, w->tangent);
        else
            copy(slope, tangent, N);
        /* a convex quadratic lies above its tangents: no step on the box is better than `inside` by more than `left` */
        for (int i = 0; i < N; i++) {
            real to_low = tangent[i] * (inside[i] - (LOW[i] - u[i]));
            real to_high = tangent[i] * (inside[i] - (HIGH[i] - u[i]));
            value += inside[i] * (tangent[i] + g[i]);
            left += 2 * LARGER(to_low, to_high);
        }
        if (value < least) {
            least = value;
            copy(inside, best, N);
        }
        *solved = (value + left - least) / (R(0.1) * F(fabs)(cost) - least) <= LEFT;
        if (*solved) break;
    }
    return least;
}

/* One iteration: u, z and their cost become better ones; returns the share of the cost that may be left. `known` says
   that z is where u leads, at that cost; what u cost is in `before` then. */
static real iteration(nsde_work *w, real *cost, int known, real *before)
{
    real chosen = 0;
    int solved = 0;
    *before = *cost;
    for (int i = 0; i < NR; i++) { /* nothing is to go after the last step */
        w->pv[K][i] = 0;
        for (int j = 0; j < LD; j++) w->p[K][i][j] = 0;
    }
    linearise(w);
    real least = box_step(w, &solved);
    for (int s = 0; s < N_SHARES; s++) { /* the last share is none of the step */
        int again = s == N_SHARES - 1 && known;
        real *u = &w->u[0][0], *step = &w->best[0][0], *tried = &w->tried[0][0];
        for (int i = 0; i < N; i++) tried[i] = clamped(u[i] + SHARES[s] * step[i], LOW[i], HIGH[i]);
        copy(w->z0, w->rolled[0], NZ);
        real own = again ? *before : rolled(w, w->tried, w->rolled);
        if (s == N_SHARES - 1) *before = own;
        if (s == 0 || own < chosen || (isnan(chosen) && !isnan(own))) {
            copy(again ? &w->z[0][0] : &w->rolled[0][0], &w->path[0][0], (K + 1) * NZ);
            copy(tried, &w->found[0][0], N);
            chosen = own;
        }
    }
    copy(&w->found[0][0], &w->u[0][0], N);
    copy(&w->path[0][0], &w->z[0][0], (K + 1) * NZ);
    *cost = chosen;
    /* near the optimum the quadratic keeps its promise, up to the second order */
    real gap = F(fabs)(-least - (*before - chosen)) / LARGER(F(fabs)(chosen), R(1e-9));
    /* a quadratic that is not solved keeps its promise too: go on while something is saved */
    real more = (*before - chosen) / LARGER(F(fabs)(chosen), R(1e-9));
    return solved ? gap : LARGER(more, gap);
}
