"""What `gsopt bench` measures: kernels (speed, growth, accuracy over time), written as JSON and drawn from it."""
