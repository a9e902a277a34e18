"""Scene files that several test modules read, and the mesh beside them."""

SCENE = """
law = "neo_hookean"
mesh = "block.vtu"
[node_sets.left]
axis = "x"
at = 0.0
[[supports]]
node_set = "left"
[[loads]]
kind = "gravity"
density = 1.1
[parameters.mu]
unit = "kPa"
range = [5, 20]
scale = "log"
[constants]
lam = 30.0
"""

HEART = """
law = "holzapfel_ogden"
mesh = "heart.vtu"
[fibres]
rule = "{rule}"
{options}
[[supports]]
node_set = "base"
[[loads]]
kind = "cavity_pressure"
facet_set = "lv_endocardium"
[[loads]]
kind = "cavity_pressure"
facet_set = "rv_endocardium"
parameter = "right_pressure"
[parameters.pressure]
unit = "kPa"
range = [0.5, 1.3]
[constants]
right_pressure = 0.3
a = 0.3
b = 2.0
a_f = 5.0
b_f = 2.0
kappa = 25.0
"""
