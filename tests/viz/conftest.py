"""Small trajectories with pictures that can be computed by hand."""

from collections.abc import Callable

import numpy as np
import pytest

from nmpm.viz import LabelledTrajectories

BOX = ((0.1, 0.9), (0.1, 0.9))
OUTER = ((0.08, 0.92), (0.08, 0.92))


@pytest.fixture
def falling() -> LabelledTrajectories:
    """Two particles of different materials that fall for eleven frames, and a prediction that lags behind."""
    fall = np.linspace(0, 0.5, 11)[:, None]
    truth = np.stack([np.array([[0.3, 0.8], [0.7, 0.8]]) - [0, step[0]] for step in fall])
    lagging = truth + np.linspace(0, 0.03, 11)[:, None, None] * [1, 0]
    return LabelledTrajectories(
        {"simulation": truth, "prediction": lagging},
        np.array(["water", "sand"]),
        bounds=BOX,
        domain=OUTER,
        dt=0.0025,
        title="falling",
    )


@pytest.fixture
def still() -> Callable[..., LabelledTrajectories]:
    """Builds trajectories of one frame from (N, D) positions."""

    def build(position: list[list[float]], material: list[str], **fields: object) -> LabelledTrajectories:
        frame = np.array([position])
        bounds = fields.pop("bounds", ((0.1, 0.9),) * frame.shape[2])
        return LabelledTrajectories({"simulation": frame}, np.array(material), bounds=bounds, dt=0.0025, **fields)  # type: ignore[arg-type]

    return build
