from skytether.client.mavlink.keys import MavlinkConfig
from skytether.client.ros2.keys import Ros2Config
from skytether.client.standby.keys import LinkConfig
from skytether.shared.fence.keys import FenceConfig
from skytether.shared.missions.keys import MissionConfig
from skytether.shared.scenario import schema
from skytether.shared.scenario.registry import Files

class Scenario(schema.Scenario, frozen=True):
    link: LinkConfig = LinkConfig()
    fence: FenceConfig = FenceConfig()
    mission: MissionConfig = MissionConfig()
    mavlink: MavlinkConfig = MavlinkConfig()
    ros2: Ros2Config = Ros2Config()
    @property
    def is_mission(self) -> bool:
        """Whether the flight is a mission: several vehicles with goals, which keep apart."""

class WithFiles(Scenario, frozen=True):
    contents: Files = ()
