"""Defences whose network knows no victim: one network of the zoo serves all, and a victim's own goes before it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from cavbench import zoo
from cavbench.core.options import choose
from cavbench.defenses.detection import shared
from cavbench.defenses.detection.judge import Judge
from cavbench.defenses.detection.marker import Marker
from cavbench.defenses.detection.masking import Masked, Masking
from cavbench.defenses.detection.segmenter import Completed, Segmenter
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.detection.victims.yolov5 import YOLOv5
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from tests.defenses.detection.test_segmenter import QUICK
from tests.detection.drawn_street import DrawnStreet
from tests.plugins.toy_camera import RedVictim

FACTS = StopSignApproach().facts


def shipped(folder: str, part: str) -> dict[str, Tensor]:
    (path,) = (Path(zoo.store.SHIPPED) / folder).glob("*.safetensors")
    return {name.removeprefix(f"{part}."): value for name, value in load_file(path).items()}


def test_the_networks_of_the_zoo_serve_a_victim_that_they_were_not_trained_beside(victim: YOLOv5) -> None:
    own = victim.load(0, FACTS)
    shown = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    masked, completed = Masking().load(victim, 0, FACTS), Segmenter().load(victim, 0, FACTS)
    assert isinstance(masked, Masked)
    assert isinstance(completed, Completed)
    judge, marker = Judge().eval(), Marker().eval()
    judge.load_state_dict(shipped("yolov3_tiny-masking-4d63159b", "judge"))
    marker.load_state_dict(shipped("yolov3_tiny-segmenter-aa7b9b32", "marker"))
    judge.freeze()
    assert torch.equal(masked.judge(shown), judge(shown))
    assert torch.equal(completed.marker(shown), marker(shown))
    for network in (masked, completed):
        assert not network.training
        assert not any(parameter.requires_grad for parameter in network.parameters())
    known = own(shown).scores
    assert torch.equal(masked(shown).scores[:, : known.shape[1]], known)
    hashes = {own.weights_sha256, masked.weights_sha256, completed.weights_sha256}
    assert len(hashes) == 3
    assert Masking().load(RedVictim(), 0, FACTS).weights_sha256 not in hashes


def test_it_stands_around_a_hardened_detector_wherever_it_is_in_a_chain() -> None:
    victim = YOLOv3Tiny()
    hardened = choose("defense", "advtrain_detection").component.load(victim, 0, FACTS)
    masked = choose("defense", "advtrain_detection+masking").component.load(victim, 0, FACTS)
    completed = choose("defense", "median+segmenter").component.load(victim, 0, FACTS)
    filtered = choose("defense", "advtrain_detection+median").component.load(victim, 0, FACTS)
    assert isinstance(masked, Masked)
    assert masked.inner.weights_sha256 == hardened.weights_sha256 == filtered.weights_sha256
    judge = choose("defense", "masking").component.load(victim, 0, FACTS)
    assert all(map(torch.equal, masked.judge.state_dict().values(), judge.judge.state_dict().values()))
    assert len({one.weights_sha256 for one in (hardened, masked, judge, completed)}) == 4
    pictures = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    known = hardened(pictures).scores
    assert torch.equal(masked(pictures).scores[:, : known.shape[1]], known)


def test_a_network_of_its_own_goes_before_the_shared_one_and_none_at_all_is_refused(
    victim: YOLOv5, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAVBENCH_ZOO", str(tmp_path))
    monkeypatch.setattr(shared, "HOST", RedVictim())
    with pytest.raises(UserError, match=r"bench train .*defense=segmenter"):
        QUICK.load(victim, 0, FACTS)

    def trained(beside: YOLOv5 | RedVictim, seed: int) -> list[Tensor]:
        made = QUICK.train(beside, DrawnStreet(), seed=seed, progress=lambda share, text: None)
        recipe = zoo.Recipe.of(beside, QUICK)
        zoo.save(made.network, recipe, seed=0, world=DrawnStreet(), card=made.card, start=made.start)
        return marks(made.network)

    def marks(detector: object) -> list[Tensor]:
        assert isinstance(detector, Completed)
        return [parameter.half().float() for parameter in detector.marker.parameters() if parameter.ndim > 1]

    of_host = trained(RedVictim(), 1)
    assert all(map(torch.equal, marks(QUICK.load(victim, 0, FACTS)), of_host))
    of_victim = trained(victim, 2)
    found = marks(QUICK.load(victim, 0, FACTS))
    assert all(map(torch.equal, found, of_victim))
    assert not all(map(torch.equal, found, of_host))
