"""The scheme "none": the paper's MPC, which takes the newest observation as the present state."""

from skytether.server.schemes import predictive

CODE = predictive.CODE
