"""Metrics of the robot end and the policy end, see `shell.processes.metrics`."""

from skytether.shell.processes.metrics import Metric, table


def _link(group: str) -> tuple[Metric, ...]:
    """Metrics of the `Exchange` whose figures are in this group."""
    return tuple(each._replace(figure=f"{group}/{each.figure}") for each in _LINK)


_LINK = table("""
sent policy_sent_parts_total
    Sent datagrams with parts of messages.
sent_bytes policy_sent_bytes_total
    Bytes of these datagrams, with UDP and IP headers.
replaced policy_replaced_messages_total
    Messages that were not sent, because a newer message replaced them.
came policy_received_parts_total
    Received datagrams with parts of messages, without duplicates.
repaired policy_repaired_parts_total
    Lost data parts that were restored from parity.
given_up policy_given_up_messages_total
    Received messages discarded incomplete, because newer ones arrived.
loss policy_loss_ratio
    Packet loss ratio of the datagrams sent.
rate_bytes_per_s policy_rate_bytes_per_second
    Send rate.
queue_s policy_queue_seconds
    Queueing delay of the newest message in the network.
round_trip_s policy_round_trip_seconds
    Round-trip time of the newest message, without processing at the other end.
""")
JOIN = table("""
calls policy_calls_total
    Calls of the robot program.
answers/{kind} policy_answers_total
    Answers by kind: chunk of this call, remaining rows, hold action, or error.
late_s_max policy_late_answer_seconds_max
    Longest time by which an answer exceeded its deadline.
observations_refused policy_refused_observations_total
    Observations that were too large or invalid.
delay_s policy_delay_seconds
    Longest time from an observation to its action chunk, of the newest 64 chunks.
step_s policy_step_seconds
    Length of a control step.
chunk_age_s policy_chunk_age_seconds
    Age of the newest chunk's observation at the newest answer.
rows_left policy_rows_left
    Rows of the newest answer computed by the policy.
image_bytes/{key} policy_image_bytes
    Compressed size of each image of the newest observation.
dropped/{reason} policy_dropped_datagrams_total
    Datagrams that were dropped, by reason.
""") + _link("link")
SERVE = table("""
robots policy_robots
    Robots with a session.
observations policy_observations_total
    Observations received.
observations_replaced policy_replaced_observations_total
    Observations that a newer one replaced while the policy was computing.
answers policy_chunks_total
    Replies of the policy.
errors policy_errors_total
    Errors of the policy.
dropped/{reason} policy_dropped_datagrams_total
    Datagrams that were dropped, by reason.
""") + _link("by_robot/{robot}")
