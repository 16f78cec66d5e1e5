"""From the residual of a declared model to the effect that it lacks."""
