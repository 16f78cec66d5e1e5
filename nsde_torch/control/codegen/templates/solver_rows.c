const unsigned nsde_work_bytes = sizeof(nsde_work), nsde_memory_bytes = sizeof(memory);

/* An iteration of problems, row by row: u, z and cost become better ones; the `first` of a solve makes the memory. */
void nsde_iterate(nsde_work *w, int rows, int first, const real *z0, real *u, real *z, const real *ref, const real *last,
                  const real *d, memory *m, real *cost, real *before, real *gap)
{
    for (int r = 0; r < rows; r++, u += N, z += (K + 1) * NZ) {
        copy(z0 + r * NZ, w->z0, NZ);
        copy(u, &w->u[0][0], N);
        copy(z, &w->z[0][0], (K + 1) * NZ);
        copy(ref + r * K * NX, &w->ref[0][0], K * NX);
        copy(last + r * NU, w->last, NU);
        copy(d + r * ND, w->d, ND);
        gap[r] = improve(w, first, &m[r], &cost[r], &before[r]);
        copy(&w->u[0][0], u, N);
        copy(&w->z[0][0], z, (K + 1) * NZ);
    }
}
