"""
The recurrent policies of sb3-contrib, as RecurrentREINFORCE trains them.

They take the arguments of sb3-contrib's classes of the same names, and ``memory``: "lstm", "gru" or "rnn".
"""

from sb3_contrib.common.recurrent.policies import (
    RecurrentActorCriticCnnPolicy,
    RecurrentActorCriticPolicy,
    RecurrentMultiInputActorCriticPolicy,
)

from sb3_reinforce.policies.sequences import RecurrentPolicy


class MlpLstmPolicy(RecurrentPolicy, RecurrentActorCriticPolicy):
    """A recurrent policy for observations that are vectors."""


class CnnLstmPolicy(RecurrentPolicy, RecurrentActorCriticCnnPolicy):
    """A recurrent policy for images."""


class MultiInputLstmPolicy(RecurrentPolicy, RecurrentMultiInputActorCriticPolicy):
    """A recurrent policy for Dict observations."""
