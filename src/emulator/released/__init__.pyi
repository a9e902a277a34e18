from .scenes import published_scene, published_tests, units

__all__ = [
    "published_scene",
    "published_tests",
    "units",
]
