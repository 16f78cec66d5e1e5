#define NSDE_NX @nx@ /* states */
#define NSDE_NU @nu@ /* inputs */
#define NSDE_NZ @nz@ /* states with the memory of effects */
#define NSDE_ND @nd@ /* pushes */

#if !defined(NSDE_FLOAT) && !defined(NSDE_DOUBLE)
#define @PRECISION@
#endif
#ifdef NSDE_FLOAT
typedef float nsde_real;
#else
typedef double nsde_real;
#endif
