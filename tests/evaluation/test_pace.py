import pytest
import torch

from nmpm.evaluation.pace import measure_machine


@pytest.mark.parametrize("dim", [2, 3])
def test_machines_are_measured_in_units_of_the_known_processor(dim):
    threads = torch.get_num_threads()
    machine = measure_machine(dim, minutes=5)
    assert 0.001 < machine.slowness < 100
    assert machine.memory > 1e8
    assert machine.minutes == 5
    assert torch.get_num_threads() == threads
