"""The physics-informed graph network: graph, layers, Algorithm 1."""
