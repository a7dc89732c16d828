"""Metrics of both ends of a policy, see `shell.processes.metrics`."""

from skytether.shell.processes.metrics import Metric, table


def _link(group: str) -> tuple[Metric, ...]:
    """Metrics of an exchange whose figures are in a group."""
    return tuple(each._replace(figure=f"{group}/{each.figure}") for each in _LINK)


_LINK = table("""
sent policy_sent_parts_total
    Datagrams with parts of messages that were sent.
sent_bytes policy_sent_bytes_total
    Bytes of these, with UDP's and IP's headers.
replaced policy_replaced_messages_total
    Messages that were not sent, because a newer one took their place.
came policy_received_parts_total
    Datagrams with parts of messages that came, copies left out.
repaired policy_repaired_parts_total
    Parts that were lost, and made from parity.
given_up policy_given_up_messages_total
    Messages of which parts came, and that a newer one has replaced.
loss policy_loss_ratio
    Share of the datagrams sent that are lost.
rate_bytes_per_s policy_rate_bytes_per_second
    Rate at which datagrams may leave.
queue_s policy_queue_seconds
    Time that the newest message waited in queues of the network.
round_trip_s policy_round_trip_seconds
    Round trip of the newest message, without its time at the other end.
""")
JOIN = table("""
calls policy_calls_total
    Calls of the robot's program.
answers/{kind} policy_answers_total
    Answers to it: the call's own chunk, the rest of earlier ones, hold, or an error.
late_s_max policy_late_answer_seconds_max
    Longest time by which an answer came after its deadline.
observations_refused policy_refused_observations_total
    Observations that were too large, or no values.
delay_s policy_delay_seconds
    Longest time from an observation to its chunk, of the newest 64.
step_s policy_step_seconds
    Time for which the program plays a row.
chunk_age_s policy_chunk_age_seconds
    Age of the observation that the newest answer was made from.
rows_left policy_rows_left
    Rows of the newest answer that the policy has made.
image_bytes/{key} policy_image_bytes
    Bytes of each image of the newest observation, as it is sent.
dropped/{reason} policy_dropped_datagrams_total
    Datagrams that were dropped, by reason.
""") + _link("link")
SERVE = table("""
robots policy_robots
    Robots in session.
observations policy_observations_total
    Observations that have come.
observations_replaced policy_replaced_observations_total
    Observations that a newer one replaced while the policy was thinking.
answers policy_chunks_total
    Answers of the policy.
errors policy_errors_total
    Errors of the policy.
dropped/{reason} policy_dropped_datagrams_total
    Datagrams that were dropped, by reason.
""") + _link("by_robot/{robot}")
