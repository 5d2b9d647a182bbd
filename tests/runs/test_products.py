"""What a run tells of its size and speed."""

from nerfies_jax.evaluation.representation import Saved
from nerfies_jax.runs import products


def test_the_size_of_a_model_is_a_metric_where_there_is_one():
    (size,) = products.model_size(Saved(2_345_678))
    assert (size.key, size.value) == ("file.bytes", 2_345_678)
    assert products.model_size(Saved()) == []
