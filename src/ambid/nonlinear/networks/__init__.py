"""Networks: state-space networks whose weights are A and B, grey residual models, and neural NARX."""
