"""Floor 2: small differentiable functions with explicit parameters."""
