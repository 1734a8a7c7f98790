"""How well an encoder registers: the paper's experiments, on any clouds."""
