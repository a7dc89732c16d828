"""The scheme "none": the paper's MPC, which plans from the newest observation as if it had no
delay.
"""

from skytether.server.schemes import predictive

make = predictive.make
KERNELS = (predictive, *predictive.KERNELS)
"""Other modules and packages whose kernels this scheme calls, see `server.schemes.table`."""
