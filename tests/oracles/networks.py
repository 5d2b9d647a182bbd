"""Encodings and networks in NumPy float64, one point at a time."""

import math

import jax
import numpy as np


def exact(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def window(bands, alpha):
    """Shares of the bands of which `alpha` are open."""
    opened = (min(max(alpha - band, 0), 1) for band in range(bands))
    return [(1 - math.cos(math.pi * share)) / 2 for share in opened]


def waves(encoding, x, opened=None):
    """Sines and cosines of each band, weighed, behind the identity."""
    x = np.atleast_1d(np.asarray(x, np.float64))
    scale = np.pi if encoding.times_pi else 1.0
    features = [x] if encoding.identity else []
    for band in range(encoding.bands):
        share = 1.0 if opened is None else opened[band]
        features += [share * f(scale * 2.0**band * x) for f in (np.sin, np.cos)]
    return np.concatenate(features) if features else x[:0]


def affine(layer, x):
    weight, bias = exact(tuple(layer))
    return x @ weight + bias


def rectified(x):
    return np.maximum(x, 0)


def trunk(layers, inputs, skips=(), activation=rectified):
    """What the last of the layers answers."""
    hidden = inputs
    for index, layer in enumerate(layers):
        if index in skips:
            hidden = np.concatenate([hidden, inputs])
        hidden = activation(affine(layer, hidden))
    return hidden


def heads(net, inputs, skips=(), activation=rectified):
    """Of a multilayer perceptron: the answer of each head, by its name."""
    hidden = trunk(net.hidden, np.asarray(inputs, np.float64), skips, activation)
    return {name: affine(head, hidden) for name, head in net.heads.items()}
