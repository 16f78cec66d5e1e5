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

enum { NX = NSDE_NX, NU = NSDE_NU, NZ = NSDE_NZ, ND = NSDE_ND };

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
