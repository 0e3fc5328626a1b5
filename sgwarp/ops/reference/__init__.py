"""Float64 oracles of the operations. Only tests, benchmarks and the report import them."""
