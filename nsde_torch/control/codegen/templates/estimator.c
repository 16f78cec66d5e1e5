enum { PAST = @past@, AHEAD = @ahead@ };

/* From a measurement, and what there was at the one before, z (as predicted; it becomes that at this one) and `push`: the
   state with memory now, the push that was learned, and the state when the next command acts. */
static void estimate(const real *state, real (*commands)[NU], const real *push, real *z, real *now, real *learned, real *later)
{
    real next[NZ];
    for (int k = 0; k < PAST; k++) {
        nsde_predict(z, commands[k], push, next);
        copy(next, z, NZ);
    }
    learn(state, z, push, learned);
    copy(z, now, NZ);
    copy(state, now, NX);
    copy(now, later, NZ);
    for (int k = PAST; k < PAST + AHEAD; k++) {
        nsde_predict(later, commands[k], learned, next);
        copy(next, later, NZ);
    }
}
