enum { PAST = @past@, AHEAD = @ahead@ };

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

/* From a measurement, and what there was at the one before, z (as predicted; it becomes that at this one) and `push`: the
   state with memory now, the push that was learned, and the state when the next command acts. */
static void estimate(const real *state, real (*commands)[NU], const real *push, real *z, real *now, real *learned, real *later)
{
    real next[NZ], off[6], by_world[3];
    for (int k = 0; k < PAST; k++) {
        nsde_predict(z, commands[k], push, next);
        copy(next, z, NZ);
    }
    copy(push, learned, ND);
    for (int i = 0; i < 3; i++) {
        by_world[i] = state[3 + i] - z[3 + i];
        off[3 + i] = state[10 + i] - z[10 + i];
    }
    rotated_back(state + 6, by_world, off);
    learn(learned, @force_at@, off, R(@force_time@), R(@force_limit@));
    learn(learned, @moment_at@, off + 3, R(@moment_time@), R(@moment_limit@));
    copy(z, now, NZ);
    copy(state, now, NX);
    copy(now, later, NZ);
    for (int k = PAST; k < PAST + AHEAD; k++) {
        nsde_predict(later, commands[k], learned, next);
        copy(next, later, NZ);
    }
}
