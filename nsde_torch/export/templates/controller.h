/* @NAME@: predictive controller of a @system@ in plain C, written by nsde_torch @VERSION@ with `nsde export format=c`.

   Build: cc -std=c99 -O2 -c @NAME@.c (never with -ffast-math); libm is all that it needs. Numbers are @dtype@;
   -DNSDE_FLOAT or -DNSDE_DOUBLE chooses anew. Nothing is allocated and nothing is global: what a call works with is
   in the structures that the caller owns, and calls on different ones may run side by side.

   Frames: @frames@.

   state      @state_doc@
   inputs     @input_doc@
   push       @push_doc@
   reference  states to track at the ends of the @steps@ steps of @step_s@ s: at t + @step_s@, t + 2 * @step_s@, ...
   memory     states of the model's effects beyond those of the machine (@memory@ here)

   Status: what a call returns, and `status` of the command. A command that leaves is finite and within bounds, always.
@status_doc@

   kept: the plan before, shifted by its age, for @keep_s@ s at most. @at_rest@: the model's inputs at rest.
   The record at the end of this file says what model this is, and with which settings it was made. */

#ifndef NSDE_CONTROLLER_H
#define NSDE_CONTROLLER_H

#ifdef __cplusplus
extern "C" {
#endif

#define NSDE_MODEL_SHA256 "@model_sha256@" /* weights of the model, for the flight's log */

@SIZES@
#define NSDE_STEP_S @step_s@     /* step of a plan [s] */
#define NSDE_PERIOD_S @period_s@ /* time between commands that it was tuned for [s] */
#define NSDE_SAMPLE_S @sample_s@ /* step of nsde_predict [s] */
#define NSDE_LATENCY_S @latency_s@ /* from a measurement to the effect of the command that follows from it [s] */
#define NSDE_PAST @past@  /* samples in a period */
#define NSDE_AHEAD @ahead@ /* samples in the latency */

@WORK@
/* A plan, to start the next from and to fall back on; {0}: there is none. */
typedef struct {
    nsde_real known, age, jumped, cost, gap; /* whether there is one; s; samples that jumped; see nsde_command */
    nsde_real solves;                        /* plans that were solved for since there was none */
    nsde_real u[NSDE_STEPS][NSDE_NU], z[NSDE_STEPS + 1][NSDE_NZ];
} nsde_plan;

typedef struct {
    nsde_real inputs[NSDE_STEPS][NSDE_NU]; /* commands; row 0 is for now, row k holds for the k-th step */
@flight@    nsde_real states[NSDE_STEPS + 1][NSDE_NX]; /* that the plan expects */
    nsde_real cost, gap; /* what the plan costs; estimated share of that which a better plan would save */
    int iterations, status;
} nsde_command;

/* A plan from a measured state; returns its status.

   state      at the time from which the plan holds: predict over the latency first, or take nsde_command_of
   valid      0: the state is rejected, whatever it says
   elapsed    time since the step that `plan` comes from [s]
   last       inputs that act now (NSDE_NU); NULL or not finite: those of the plan before
   push       disturbance (NSDE_ND); NULL or not finite: none
   memory     (NSDE_NZ - NSDE_NX); NULL or not finite: stationary under `last`
   plan       that before; becomes the new one */
int nsde_step(nsde_work *work, const nsde_real state[NSDE_NX], int valid, nsde_real elapsed,
              const nsde_real reference[NSDE_STEPS][NSDE_NX], const nsde_real *last, const nsde_real *push,
              const nsde_real *memory, nsde_plan *plan, nsde_command *out);

/* State with memory (NSDE_NZ) NSDE_SAMPLE_S later, under held inputs (NSDE_NU) and a push (NSDE_ND). */
void nsde_predict(const nsde_real *z, const nsde_real *u, const nsde_real *push, nsde_real *after);

/* The controller with its estimator of disturbances and of the state at the end of the latency: one call a period. */
typedef struct {
    nsde_work work;
    nsde_plan plan;
    nsde_real z[NSDE_NZ], push[NSDE_ND + 1], commands[NSDE_PAST + NSDE_AHEAD][NSDE_NU];
} nsde_pilot;

/* Starts from a measured state, with the inputs of rest. */
void nsde_reset(nsde_pilot *pilot, const nsde_real state[NSDE_NX]);

/* The command of a period from the newest measured state; returns its status. The reference is that from the time on at
   which the command acts: its first row is for NSDE_LATENCY_S + NSDE_STEP_S after the state was measured. A measurement
   that is not finite is left out, and the model's prediction takes its place in the estimator. */
int nsde_command_of(nsde_pilot *pilot, const nsde_real state[NSDE_NX], int valid,
                    const nsde_real reference[NSDE_STEPS][NSDE_NX], nsde_command *out);

extern const unsigned nsde_work_bytes, nsde_pilot_bytes; /* memory that the structures take */

#ifdef __cplusplus
}
#endif
#endif

/* nsde record
@RECORD@
*/
