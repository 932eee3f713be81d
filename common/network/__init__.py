"""The RBF network: scattered heights in, a surface out; every neuron is a Gaussian."""

from common.network.estimator import NetworkWarning, RBFNetwork

__all__ = ["NetworkWarning", "RBFNetwork"]
