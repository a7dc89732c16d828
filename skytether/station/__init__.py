"""Ground station that flies a vehicle as is usual without Skytether: by set-points alone.

The station sends an autopilot MAVLink set-points at every step, through whatever network lies
between. It is here only as a baseline for comparison.
"""
