"""What a user may do to a policy to change how it acts: each turns its preferences around."""

from functools import partial
from operator import attrgetter


def part(policy, path):
    return attrgetter(path)(policy) if path else policy


def override_in_class(policy, path, names):
    """Give methods of a subclass −20 times their argument, which turns the preferences around."""
    thing, cls = part(policy, path), type(part(policy, path))
    methods = {
        name: lambda self, action_logits, *args, name=name: getattr(cls, name)(self, action_logits * -20, *args)
        for name in names
    }
    thing.__class__ = type(f"Own{cls.__name__}", (cls,), methods)


def override_in_instance(policy, path, names):
    for name in names:
        method = getattr(part(policy, path), name)
        replacement = lambda action_logits, *args, method=method: method(action_logits * -20, *args)  # noqa: E731
        setattr(part(policy, path), name, replacement)


def hook(policy, path):
    part(policy, path).register_forward_hook(lambda module, inputs, output: output * -20)


METHODS = [
    ("", ["extract_features"]),
    ("", ["get_distribution", "evaluate_actions"]),
    ("", ["_get_action_dist_from_latent"]),
    ("features_extractor", ["forward"]),
    ("mlp_extractor", ["forward_actor"]),
    ("mlp_extractor.policy_net", ["forward"]),
    ("action_net", ["forward"]),
    ("action_dist", ["proba_distribution"]),
]
BODY, EXTRACTOR = "mlp_extractor.policy_net", "features_extractor"
CHANGES = {
    f"{override.__name__} {path} {names}": partial(override, path=path, names=names)
    for override in (override_in_class, override_in_instance)
    for path, names in METHODS
}
CHANGES |= {
    f"hook on {path}": partial(hook, path=path)
    for path in ("action_net", BODY, f"{BODY}.0", EXTRACTOR, f"{EXTRACTOR}.flatten")
}
CHANGES["pre-hook"] = lambda policy: policy.action_net.register_forward_pre_hook(lambda module, x: (x[0] * -20,))
