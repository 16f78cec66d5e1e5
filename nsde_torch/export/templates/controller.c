/* The controller that @NAME@.h describes; written by nsde_torch @VERSION@. Do not edit: export it anew.

   One iteration linearises all steps about inputs u and states z, which need not fit each other,

       dz' = A dz + B du + gap,        cost = sum |r + J (A dz + B du)|^2 + input terms,    low - u <= du <= high - u

   and finds du by primal-dual active sets (Hintermueller, Ito, Kunisch, SIAM J. Optim. 13, 2003). Which inputs are held
   at a bound follows from the slope over the diagonal of the condensed Hessian; the others solve the linear-quadratic
   problem that is left, by Riccati's recursion. Shares of du are rolled out, and the cheapest is kept. */

#include "@NAME@.h"

#include <math.h>
#include <stddef.h>

#ifdef __FAST_MATH__
#error "with -ffast-math, states that are no numbers would be accepted: build without it"
#endif

#ifdef NSDE_FLOAT
#define F(name) name##f
#else
#define F(name) name
#endif
#define R(x) ((nsde_real)(x))
#define SMALLER(a, b) ((a) < (b) ? (a) : (b))
#define LARGER(a, b) ((a) > (b) ? (a) : (b))

typedef nsde_real real;

enum {
    NX = NSDE_NX, NU = NSDE_NU, NZ = NSDE_NZ, ND = NSDE_ND, K = NSDE_STEPS, N = K * NU,
    NR = NSDE_ROWS,     /* states of the recursion: with a weight on changes of the inputs, the inputs before too */
    LD = NSDE_STRIDE,   /* their number, rounded up for vector instructions */
};
enum { BAD_STATE = 1, BAD_REFERENCE, JUMP, DIVERGED };

static const real LOW = R(@low@), HIGH = R(@high@);
static const real INPUT_WEIGHT = R(@input_weight@), INPUT_CENTRE = R(@input_centre@), RATE_WEIGHT = R(@rate_weight@);
static const real TOLERANCE = R(@tolerance@), LEFT = R(@left@);
static const real SHARES[] = {@shares@};
static const real HOVER[NU] = {@hover@};
enum { ITERATIONS = @iterations@, CHANGES = @changes@, N_SHARES = (int)(sizeof SHARES / sizeof *SHARES) };

const unsigned nsde_work_bytes = sizeof(nsde_work), nsde_pilot_bytes = sizeof(nsde_pilot);

static real clamped(real x, real low, real high) { return x < low ? low : x > high ? high : x; }

static int finite(const real *x, int n)
{
    for (int i = 0; i < n; i++)
        if (!isfinite(x[i])) return 0;
    return 1;
}

static void copy(const real *from, real *to, int n)
{
    for (int i = 0; i < n; i++) to[i] = from[i];
}

/* ---- the model, generated ------------------------------------------------------------------------------- */

@MODEL@
/* ---- the problem ---------------------------------------------------------------------------------------- */

static real input_cost(real (*u)[NU], const real *last)
{
    real sum = 0;
    for (int k = 0; k < K; k++)
        for (int i = 0; i < NU; i++) {
            real centred = u[k][i] - INPUT_CENTRE, change = u[k][i] - (k ? u[k - 1][i] : last[i]);
            sum += INPUT_WEIGHT * centred * centred + RATE_WEIGHT * change * change;
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
            slope[k][i] += INPUT_WEIGHT * (w->u[k][i] + du[k][i] - INPUT_CENTRE) + RATE_WEIGHT * (now - later);
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
        for (int i = 0; i < NU; i++) w->scale[k][i] = own[i][i] + INPUT_WEIGHT + RATE_WEIGHT * (k < K - 1 ? 2 : 1);
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
        huu[i][i] += INPUT_WEIGHT + RATE_WEIGHT;
        hu[i] += INPUT_WEIGHT * (w->u[k][i] - INPUT_CENTRE) + RATE_WEIGHT * change_at(w, k, i);
    }
#if NSDE_ROWS > NSDE_NZ
    for (int i = 0; i < NU; i++) {
        hux[i][NZ + i] -= RATE_WEIGHT;
        w->p[k][NZ + i][NZ + i] += RATE_WEIGHT;
        hx[NZ + i] = -RATE_WEIGHT * change_at(w, k, i);
    }
#endif
    for (int i = 0; i < NU; i++) {
        real held = w->held[k][i] < 0 ? LOW - w->u[k][i] : w->held[k][i] > 0 ? HIGH - w->u[k][i] : 0;
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

/* The best step on the box that was found, in w->best, and what the quadratic saves by it. */
static real box_step(nsde_work *w)
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
    for (int i = 0; i < N; i++) best[i] = clamped(-g[i] / scale[i], LOW - u[i], HIGH - u[i]);
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
            signed char now = (signed char)(aim < LOW - u[i] ? -1 : aim > HIGH - u[i] ? 1 : 0);
            if (now != held[i]) from = i / NU;
            held[i] = now;
        }
        newton(w, from, w->step);
        slope_at(w, w->step, w->slope);
        for (int i = 0; i < N; i++) {
            inside[i] = clamped(step[i], LOW - u[i], HIGH - u[i]);
            outside |= inside[i] != step[i];
        }
        if (outside)
            slope_at(w, w->inside, w->tangent);
        else
            copy(slope, tangent, N);
        /* a convex quadratic lies above its tangents: no step on the box is better than `inside` by more than `left` */
        for (int i = 0; i < N; i++) {
            real to_low = tangent[i] * (inside[i] - (LOW - u[i])), to_high = tangent[i] * (inside[i] - (HIGH - u[i]));
            value += inside[i] * (tangent[i] + g[i]);
            left += 2 * LARGER(to_low, to_high);
        }
        if (value < least) {
            least = value;
            copy(inside, best, N);
        }
        if ((value + left - least) / (R(0.1) * F(fabs)(cost) - least) <= LEFT) break;
    }
    return least;
}

/* One iteration: u, z and their cost become better ones; returns the share of the cost that may be left. `known` says
   that z is where u leads, at that cost. */
static real iteration(nsde_work *w, real *cost, int known)
{
    real after[NZ], before = *cost, chosen = 0;
    for (int k = 0; k < K; k++) {
        step_slopes(w->z[k], w->u[k], w->d, w->a[k], w->b[k], after);
        w->square[k] = cost_slopes(after, w->ref[k], w->q[k], w->g[k]);
        for (int i = 0; i < NZ; i++) w->gap[k][i] = after[i] - w->z[k + 1][i];
    }
    real least = box_step(w);
    for (int s = 0; s < N_SHARES; s++) { /* the last share is none of the step */
        int again = s == N_SHARES - 1 && known;
        real *u = &w->u[0][0], *step = &w->best[0][0], *tried = &w->tried[0][0];
        for (int i = 0; i < N; i++) tried[i] = clamped(u[i] + SHARES[s] * step[i], LOW, HIGH);
        copy(w->z0, w->rolled[0], NZ);
        real own = again ? before : rolled(w, w->tried, w->rolled);
        if (s == N_SHARES - 1) before = own;
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
    return F(fabs)(-least - (before - chosen)) / LARGER(F(fabs)(chosen), R(1e-9));
}

/* ---- the step ------------------------------------------------------------------------------------------- */

/* Rows at times later by a number of steps, between two of them by interpolation; the end is held. */
static void shifted(const real *table, int n, int width, real steps, real *out)
{
    for (int k = 0; k < n; k++) {
        real at = clamped(R(k) + steps, 0, R(n - 1));
        int low = SMALLER((int)at, LARGER(n - 2, 0)), high = SMALLER(low + 1, n - 1);
        real share = at - R(low);
        for (int i = 0; i < width; i++)
            out[k * width + i] = (1 - share) * table[low * width + i] + share * table[high * width + i];
    }
}

static real length(const real *x, int n)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += x[i] * x[i];
    return F(sqrt)(sum);
}

int nsde_step(nsde_work *w, const nsde_real state[NSDE_NX], int valid, nsde_real elapsed,
              const nsde_real reference[NSDE_STEPS][NSDE_NX], const nsde_real *last, const nsde_real *push,
              const nsde_real *memory, nsde_plan *plan, nsde_command *out)
{
    real x[NX], still[NZ], origin[NX] = {0}, late = isfinite(elapsed) ? LARGER(elapsed, 0) : 0;
    /* the plan before, at this time; one that was not kept as it was is none */
    shifted(&plan->u[0][0], K, NU, SMALLER(late / R(NSDE_STEP_S), R(K)), &w->u[0][0]);
    shifted(&plan->z[0][0], K + 1, NZ, SMALLER(late / R(NSDE_STEP_S), R(K)), &w->z[0][0]);
    int known = plan->known > R(0.5) && isfinite(elapsed) && !isnan(plan->known) && !isnan(plan->age);
    known = known && !isnan(plan->jumped) && !isnan(plan->cost) && !isnan(plan->gap);
    known = known && finite(&plan->u[0][0], N) && finite(&w->z[0][0], (K + 1) * NZ);
    real age = known ? plan->age + late : R(INFINITY), jumps = known ? plan->jumped : 0;
    real cost_before = known ? plan->cost : 0, gap_before = known ? plan->gap : 0;
    origin[6] = 1;
    augment(origin, HOVER, still);
    for (int k = 0; k <= K; k++) {
        for (int i = 0; i < NU && k < K; i++) w->u[k][i] = known ? clamped(w->u[k][i], LOW, HIGH) : HOVER[i];
        if (!known) copy(still, w->z[k], NZ);
    }
    copy(last && finite(last, NU) ? last : w->u[0], w->last, NU);
    for (int i = 0; i < ND; i++) w->d[i] = push && finite(push, ND) ? push[i] : 0;

    /* which states and references are accepted */
    const real *expected = w->z[0];
    real away[3], turned = 0;
    for (int i = 0; i < 3; i++) away[i] = state[i] - expected[i];
    for (int i = 6; i < 10; i++) turned += state[i] * expected[i];
    turned = 2 * F(acos)(SMALLER(F(fabs)(turned), 1));
    int whole = finite(state, NX), jumped = whole && known && age <= R(@keep@);
    jumped = jumped && (length(away, 3) > R(@jump@) || turned > R(@jump_attitude@));
    jumps = jumped ? jumps + 1 : 0;
    int accepted = whole && F(fabs)(length(state + 6, 4) - 1) <= R(@quaternion@) && valid;
    int trouble = !accepted                                     ? BAD_STATE
                  : !finite(&reference[0][0], K * NX)           ? BAD_REFERENCE
                  : jumped && jumps < R(@jump_samples@)         ? JUMP
                                                                : 0;
    copy(trouble ? expected : state, x, NX);
    real norm = LARGER(length(x + 6, 4), R(1e-12));
    for (int i = 6; i < 10; i++) x[i] /= norm;
    augment(x, w->last, w->z0);
    if (NZ > NX && memory && finite(memory, NZ - NX)) copy(memory, w->z0 + NX, NZ - NX);

    copy(&w->u[0][0], &w->start_u[0][0], N);
    copy(&w->z[0][0], &w->start_z[0][0], (K + 1) * NZ);
    real cost = R(INFINITY), gap = R(INFINITY);
    out->iterations = 0;
    if (!trouble) {
        copy(&reference[0][0], &w->ref[0][0], K * NX);
        for (int i = 0; i < NR; i++) {
            w->pv[K][i] = 0;
            for (int j = 0; j < LD; j++) w->p[K][i][j] = 0;
        }
        if (!known) {
            copy(w->z0, w->z[0], NZ);
            cost = rolled(w, w->u, w->z);
        }
        do {
            gap = iteration(w, &cost, !known || out->iterations > 0);
            out->iterations++;
        } while (!(gap <= TOLERANCE) && out->iterations < ITERATIONS);
    }

    /* the plan, or what takes its place: that before, then hovering where the machine is */
    int safe = !trouble && isfinite(cost) && finite(&w->u[0][0], N), kept = known && age <= R(@keep@);
    int status = safe ? !(gap <= TOLERANCE) : 2 * (trouble ? trouble : DIVERGED) + !kept;
    if (!safe) {
        const real *rest = finite(w->z0, NZ) ? w->z0 : still;
        copy(kept ? &w->start_u[0][0] : &w->u[0][0], &w->u[0][0], N);
        copy(kept ? &w->start_z[0][0] : &w->z[0][0], &w->z[0][0], (K + 1) * NZ);
        for (int k = 0; k <= K && !kept; k++) {
            copy(rest, w->z[k], NZ);
            if (k < K) copy(HOVER, w->u[k], NU);
        }
        cost = kept ? cost_before : R(INFINITY);
        gap = kept ? gap_before : R(INFINITY);
    }
    plan->known = 1;
    plan->age = safe ? 0 : kept ? age : R(INFINITY);
    plan->jumped = jumps;
    plan->cost = out->cost = cost;
    plan->gap = out->gap = gap;
    out->status = status;
    out->thrust = 0;
    for (int k = 0; k <= K; k++) {
        copy(w->z[k], plan->z[k], NZ);
        copy(w->z[k], out->states[k], NX);
        if (k == K) break;
        for (int i = 0; i < NU; i++) plan->u[k][i] = out->inputs[k][i] = clamped(w->u[k][i], LOW, HIGH);
        out->lift[k] = lift(w->z[k], out->inputs[k]);
    }
    for (int i = 0; i < NU; i++) out->thrust += out->inputs[0][i] / NU;
    copy(w->z[1] + 10, out->rates, 3);
    return status;
}

/* ---- the estimator -------------------------------------------------------------------------------------- */

enum { PAST = NSDE_PAST, AHEAD = NSDE_AHEAD };

void nsde_reset(nsde_pilot *p, const nsde_real state[NSDE_NX])
{
    p->plan.known = 0;
    augment(state, HOVER, p->z);
    for (int i = 0; i < ND; i++) p->push[i] = 0;
    for (int k = 0; k < PAST + AHEAD; k++) copy(HOVER, p->commands[k], NU);
}

/* Vector from world to body axes. */
static void rotated_back(const real *q, const real *v, real *out)
{
    real s[3];
    for (int i = 0; i < 3; i++) s[i] = 2 * (q[1 + (i + 1) % 3] * v[(i + 2) % 3] - q[1 + (i + 2) % 3] * v[(i + 1) % 3]);
    for (int i = 0; i < 3; i++)
        out[i] = v[i] - q[0] * s[i] + q[1 + (i + 1) % 3] * s[(i + 2) % 3] - q[1 + (i + 2) % 3] * s[(i + 1) % 3];
}

/* Adds what a port's prediction was off by, over a time constant, to its push; a place below 0: there is no such port. */
static void learn(real *push, int place, const real *off, real time, real limit)
{
    for (int i = place; place >= 0 && time > 0 && i < place + 3; i++)
        push[i] = clamped(push[i] + off[i - place] / time, -limit, limit);
}

int nsde_command_of(nsde_pilot *p, const nsde_real state[NSDE_NX], int valid,
                    const nsde_real reference[NSDE_STEPS][NSDE_NX], nsde_command *out)
{
    real z[NZ], now[NZ], later[NZ], next[NZ], push[ND + 1], off[6], by_world[3];
    copy(p->z, z, NZ);
    for (int k = 0; k < PAST; k++) {
        nsde_predict(z, p->commands[k], p->push, next);
        copy(next, z, NZ);
    }
    copy(p->push, push, ND);
    for (int i = 0; i < 3; i++) {
        by_world[i] = state[3 + i] - z[3 + i];
        off[3 + i] = state[10 + i] - z[10 + i];
    }
    rotated_back(state + 6, by_world, off);
    learn(push, @force_at@, off, R(@force_time@), R(@force_limit@));
    learn(push, @moment_at@, off + 3, R(@moment_time@), R(@moment_limit@));
    copy(z, now, NZ);
    copy(state, now, NX);
    copy(now, later, NZ);
    for (int k = PAST; k < PAST + AHEAD; k++) {
        nsde_predict(later, p->commands[k], push, next);
        copy(next, later, NZ);
    }
    int good = finite(state, NX) && finite(later, NZ);
    copy(good ? now : z, p->z, NZ); /* without a measurement, as predicted */
    if (good) copy(push, p->push, ND);
    int status = nsde_step(&p->work, later, valid, R(NSDE_PERIOD_S), reference, p->commands[PAST + AHEAD - 1], p->push,
                           later + NX, &p->plan, out);
    for (int k = 0; k < AHEAD; k++) copy(p->commands[k + PAST], p->commands[k], NU);
    for (int k = AHEAD; k < PAST + AHEAD; k++) copy(out->inputs[0], p->commands[k], NU);
    return status;
}
