"""Commands of the laboratory: sweeps, searches, reproduction, comparison and torture."""

from skytether.shared.base import extras

extras.need("lab")
