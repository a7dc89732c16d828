"""The scheme "none": the paper's plans from the newest observation, taken for the present."""

from skytether.server.schemes import predictive

make = predictive.make
KERNELS = (predictive, *predictive.KERNELS)
"""See `server.schemes.table`."""
