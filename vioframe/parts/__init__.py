"""Finding parts: hooks, the registry, their options, and the configuration that names them."""
