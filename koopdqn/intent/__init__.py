"""Human intent: where a person would go next, as a Koopman model, and where that model can be trusted."""
