"""Model predictive control: plans, solvers, references and closed loops."""
