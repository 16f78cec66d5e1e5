
/* Updates of machines, row by row; see `estimate`. */
void nsde_estimate(int rows, const real *x, const real *z, const real *d, real *commands, real *now, real *learned,
                   real *later)
{
    for (int r = 0; r < rows; r++) {
        real predicted[NZ];
        copy(z + r * NZ, predicted, NZ);
        estimate(x + r * NX, (real (*)[NU])(commands + r * (PAST + AHEAD) * NU), d + r * ND, predicted, now + r * NZ,
                 learned + r * ND, later + r * NZ);
    }
}
