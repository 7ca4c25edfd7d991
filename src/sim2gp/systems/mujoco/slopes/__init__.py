"""Derivatives of MuJoCo's steps in closed form, of many steps at once.

`numbers` reads what a compiled model says of its links, joints and actuators;
`rigid_body` is the inverse dynamics of the tree and its derivatives; `residual` is the
equation that a step solves; `step` differentiates it.
"""
