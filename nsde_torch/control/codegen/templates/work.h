#define NSDE_STEPS @steps@
/* What a step works with; needs no beginning, and holds nothing from call to call. */
#define NSDE_ROWS @rows@
#define NSDE_STRIDE @stride@
typedef struct {
    nsde_real a[NSDE_STEPS][@na@], b[NSDE_STEPS][@nb@], q[NSDE_STEPS][@nq@], g[NSDE_STEPS][NSDE_NX], square[NSDE_STEPS];
    nsde_real gap[NSDE_STEPS][NSDE_NZ], s[NSDE_STEPS][NSDE_NX];
    nsde_real p[NSDE_STEPS + 1][NSDE_ROWS][NSDE_STRIDE], pv[NSDE_STEPS + 1][NSDE_ROWS];
    nsde_real gain[NSDE_STEPS][NSDE_NU][NSDE_STRIDE], feed[NSDE_STEPS][NSDE_NU];
    nsde_real u[NSDE_STEPS][NSDE_NU], start_u[NSDE_STEPS][NSDE_NU], tried[NSDE_STEPS][NSDE_NU];
    nsde_real found[NSDE_STEPS][NSDE_NU], best[NSDE_STEPS][NSDE_NU], step[NSDE_STEPS][NSDE_NU];
    nsde_real inside[NSDE_STEPS][NSDE_NU], slope[NSDE_STEPS][NSDE_NU], tangent[NSDE_STEPS][NSDE_NU];
    nsde_real gradient[NSDE_STEPS][NSDE_NU], scale[NSDE_STEPS][NSDE_NU];
    nsde_real z[NSDE_STEPS + 1][NSDE_NZ], start_z[NSDE_STEPS + 1][NSDE_NZ];
    nsde_real rolled[NSDE_STEPS + 1][NSDE_NZ], path[NSDE_STEPS + 1][NSDE_NZ];
    nsde_real ref[NSDE_STEPS][NSDE_NX], z0[NSDE_NZ], last[NSDE_NU], d[NSDE_ND + 1];
    signed char held[NSDE_STEPS][NSDE_NU];
} nsde_work;
