"""The scheme "none": the paper's MPC, which takes the newest observation as the present state."""

from skytether.server.schemes.predictive import CODE as PREDICTIVE

CODE = PREDICTIVE
