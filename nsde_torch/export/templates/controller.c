/* The controller that @NAME@.h describes; written by nsde_torch @VERSION@. Do not edit: export it anew. */

#include "@NAME@.h"

@COMMON@
@SOLVER@
/* ---- the model of the step and of the estimator --------------------------------------------------------- */

@PREDICTION@
enum { BAD_STATE = 1, BAD_REFERENCE, JUMP, DIVERGED };

static const real TOLERANCE = R(@tolerance@), HOVER[NU] = {@hover@}, ORIGIN[NX] = {@origin@};
enum { ITERATIONS = @iterations@ };
#define ANEW @anew@ /* solves between two that start at rest too; 0: none does */
#define QUATERNION @quaternion@ /* first column of the attitude; -1: there is none */
#define FLIES @flies@

const unsigned nsde_work_bytes = sizeof(nsde_work), nsde_pilot_bytes = sizeof(nsde_pilot);

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

#if QUATERNION >= 0
static real length(const real *x, int n)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += x[i] * x[i];
    return F(sqrt)(sum);
}
#endif

/* The plan of w improved until little is left; returns the iterations. `rolled_out`: its states are where u leads. */
static int solved(nsde_work *w, int rolled_out, real *cost, real *gap)
{
    int count = 0;
    real at_start;
    do {
        *gap = iteration(w, cost, rolled_out || count > 0, &at_start);
        count++;
    } while (!(*gap <= TOLERANCE) && count < ITERATIONS);
    return count;
}

int nsde_step(nsde_work *w, const nsde_real state[NSDE_NX], int valid, nsde_real elapsed,
              const nsde_real reference[NSDE_STEPS][NSDE_NX], const nsde_real *last, const nsde_real *push,
              const nsde_real *memory, nsde_plan *plan, nsde_command *out)
{
    real x[NX], still[NZ], late = isfinite(elapsed) ? LARGER(elapsed, 0) : 0;
    /* the plan before, at this time; one that was not kept as it was is none */
    shifted(&plan->u[0][0], K, NU, SMALLER(late / R(NSDE_STEP_S), R(K)), &w->u[0][0]);
    shifted(&plan->z[0][0], K + 1, NZ, SMALLER(late / R(NSDE_STEP_S), R(K)), &w->z[0][0]);
    int known = plan->known > R(0.5) && isfinite(elapsed) && !isnan(plan->known) && !isnan(plan->age);
    known = known && !isnan(plan->jumped) && !isnan(plan->cost) && !isnan(plan->gap) && !isnan(plan->solves);
    known = known && finite(&plan->u[0][0], N) && finite(&w->z[0][0], (K + 1) * NZ);
    real age = known ? plan->age + late : R(INFINITY), jumps = known ? plan->jumped : 0;
    real cost_before = known ? plan->cost : 0, gap_before = known ? plan->gap : 0, solves = known ? plan->solves : 0;
    augment(ORIGIN, HOVER, still);
    for (int k = 0; k <= K; k++) {
        for (int i = 0; i < NU && k < K; i++) w->u[k][i] = known ? clamped(w->u[k][i], LOW[i], HIGH[i]) : HOVER[i];
        if (!known) copy(still, w->z[k], NZ);
    }
    copy(last && finite(last, NU) ? last : w->u[0], w->last, NU);
    for (int i = 0; i < ND; i++) w->d[i] = push && finite(push, ND) ? push[i] : 0;

    /* which states and references are accepted */
    const real *expected = w->z[0];
    int whole = finite(state, NX), accepted = whole && valid, far = 0;
#if QUATERNION >= 0
    real turned = 0;
    for (int i = QUATERNION; i < QUATERNION + 4; i++) turned += state[i] * expected[i];
    far = 2 * F(acos)(SMALLER(F(fabs)(turned), 1)) > R(@jump_attitude@);
    accepted = accepted && F(fabs)(length(state + QUATERNION, 4) - 1) <= R(@unit@);
#endif
#if FLIES
    real away[3];
    for (int i = 0; i < 3; i++) away[i] = state[i] - expected[i];
    far = far || length(away, 3) > R(@jump@);
#endif
    int jumped = whole && known && age <= R(@keep@) && far;
    jumps = jumped ? jumps + 1 : 0;
    int trouble = !accepted                                     ? BAD_STATE
                  : !finite(&reference[0][0], K * NX)           ? BAD_REFERENCE
                  : jumped && jumps < R(@jump_samples@)         ? JUMP
                                                                : 0;
    copy(trouble ? expected : state, x, NX);
#if QUATERNION >= 0
    real norm = LARGER(length(x + QUATERNION, 4), R(1e-12));
    for (int i = QUATERNION; i < QUATERNION + 4; i++) x[i] /= norm;
#endif
    augment(x, w->last, w->z0);
    if (NZ > NX && memory && finite(memory, NZ - NX)) copy(memory, w->z0 + NX, NZ - NX);

    copy(&w->u[0][0], &w->start_u[0][0], N);
    copy(&w->z[0][0], &w->start_z[0][0], (K + 1) * NZ);
    real cost = R(INFINITY), gap = R(INFINITY);
    out->iterations = 0;
    if (!trouble) {
        copy(&reference[0][0], &w->ref[0][0], K * NX);
        if (!known) {
            copy(w->z0, w->z[0], NZ);
            cost = rolled(w, w->u, w->z);
        }
        out->iterations = solved(w, !known, &cost, &gap);
        solves += 1;
#if ANEW
        if (known && (int)solves % ANEW == 0) { /* from rest too, while the plan before is where this one waits */
            real other = R(INFINITY), other_gap;
            copy(&w->u[0][0], &plan->u[0][0], N);
            copy(&w->z[0][0], &plan->z[0][0], (K + 1) * NZ);
            for (int k = 0; k <= K; k++) {
                copy(w->z0, w->z[k], NZ);
                if (k < K) copy(HOVER, w->u[k], NU);
            }
            solved(w, 0, &other, &other_gap);
            if (other < cost) {
                cost = other;
                gap = other_gap;
            } else {
                copy(&plan->u[0][0], &w->u[0][0], N);
                copy(&plan->z[0][0], &w->z[0][0], (K + 1) * NZ);
            }
        }
#endif
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
    plan->solves = solves;
    plan->cost = out->cost = cost;
    plan->gap = out->gap = gap;
    out->status = status;
    for (int k = 0; k <= K; k++) {
        copy(w->z[k], plan->z[k], NZ);
        copy(w->z[k], out->states[k], NX);
        if (k == K) break;
        for (int i = 0; i < NU; i++) plan->u[k][i] = out->inputs[k][i] = clamped(w->u[k][i], LOW[i], HIGH[i]);
    }
#if FLIES
    out->thrust = 0;
    for (int i = 0; i < NU; i++) out->thrust += out->inputs[0][i] / NU;
    for (int k = 0; k < K; k++) out->lift[k] = lift(w->z[k], out->inputs[k]);
    copy(w->z[1] + 10, out->rates, 3);
#endif
    return status;
}

/* ---- the estimator -------------------------------------------------------------------------------------- */

@ESTIMATOR@
void nsde_reset(nsde_pilot *p, const nsde_real state[NSDE_NX])
{
    p->plan.known = 0;
    augment(state, HOVER, p->z);
    for (int i = 0; i < ND; i++) p->push[i] = 0;
    for (int k = 0; k < PAST + AHEAD; k++) copy(HOVER, p->commands[k], NU);
}

int nsde_command_of(nsde_pilot *p, const nsde_real state[NSDE_NX], int valid,
                    const nsde_real reference[NSDE_STEPS][NSDE_NX], nsde_command *out)
{
    real z[NZ], now[NZ], later[NZ], push[ND + 1];
    copy(p->z, z, NZ);
    estimate(state, p->commands, p->push, z, now, push, later);
    int good = finite(state, NX) && finite(later, NZ);
    copy(good ? now : z, p->z, NZ); /* without a measurement, as predicted */
    if (good) copy(push, p->push, ND);
    int status = nsde_step(&p->work, later, valid, R(NSDE_PERIOD_S), reference, p->commands[PAST + AHEAD - 1], p->push,
                           later + NX, &p->plan, out);
    for (int k = 0; k < AHEAD; k++) copy(p->commands[k + PAST], p->commands[k], NU);
    for (int k = AHEAD; k < PAST + AHEAD; k++) copy(out->inputs[0], p->commands[k], NU);
    return status;
}
