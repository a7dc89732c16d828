"""The scheme "none": the paper's MPC, which takes the newest observation as the present state."""

from skytether.server.schemes import predictive

make = predictive.make
KERNELS = (predictive, *predictive.KERNELS)
"""Other modules and packages whose kernels this scheme calls, see `server.schemes.table`."""
