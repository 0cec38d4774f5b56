"""The recurrent policies of sb3-contrib, as RecurrentREINFORCE trains them."""

from sb3_contrib.common.recurrent.policies import (
    RecurrentActorCriticCnnPolicy,
    RecurrentActorCriticPolicy,
    RecurrentMultiInputActorCriticPolicy,
)

from sb3_reinforce.policies.sequences import RecurrentPolicy


class MlpLstmPolicy(RecurrentPolicy, RecurrentActorCriticPolicy):
    """For observations that are vectors."""


class CnnLstmPolicy(RecurrentPolicy, RecurrentActorCriticCnnPolicy):
    """For images."""


class MultiInputLstmPolicy(RecurrentPolicy, RecurrentMultiInputActorCriticPolicy):
    """For Dict observations."""
