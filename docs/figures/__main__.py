"""`python -m docs.figures [NAME...] [--out FOLDER]`: make the named figures, or all of them."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from cavbench.run.process import settle

FIGURES = {
    "finding_attacks.png": "findings:attacks",
    "finding_filters.png": "findings:filters",
    "finding_faults.png": "findings:faults",
    "finding_trainings.png": "findings:trainings",
    "finding_detectors.png": "findings:detectors",
    "finding_patches.png": "findings:patches",
    "attack_none.svg": "attacks:none",
    "attack_noise.svg": "attacks:noise",
    "attack_bias.svg": "memory:bias",
    "attack_pessimist.svg": "attacks:pessimist",
    "attack_plan.svg": "attacks:plan",
    "attack_rehearse.svg": "attacks:rehearse",
    "attack_zo.svg": "attacks:zo",
    "attack_pgd.svg": "attacks:pgd",
    "traffic_cut_in.svg": "traffic:cut_in",
    "set_presence.svg": "sets:presence",
    "set_latency.svg": "sets:latency",
    "set_held.svg": "sets:held",
    "set_actuator.svg": "sets:actuator",
    "set_dynamics.svg": "sets:dynamics",
    "attack_two_stage.svg": "attacks:two_stage",
    "attack_paad.svg": "attacks:paad",
    "attack_sarsa.svg": "attacks:sarsa",
    "attack_art.svg": "attacks:art",
    "attack_eot.png": "sign_patches:eot",
    "attack_square_patch.png": "sign_patches:square_patch",
    "attack_transfer.png": "sign_patches:transfer",
    "attack_noise_patch.png": "sign_patches:noise_patch",
    "attack_grey_patch.png": "sign_patches:grey_patch",
    "mounts.png": "mounts:mounts",
    "defense_none.svg": "hardening:none",
    "defense_frame_stack.svg": "memory:frame_stack",
    "defense_smoothing.svg": "smoothing:smoothing",
    "defense_pessimist_q.svg": "intervals:pessimist_q",
    "defense_shield.svg": "intervals:shield",
    "defense_tracker.svg": "intervals:tracker",
    "defense_advtrain.svg": "hardening:advtrain",
    "defense_sa.svg": "hardening:sa",
    "defense_car.svg": "hardening:car",
    "defense_atla.png": "alternating:atla",
    "defense_advtrain_detection.svg": "hardening:advtrain_detection",
    "defense_median.png": "filters:median",
    "defense_jpeg.png": "filters:jpeg",
    "defense_segmenter.png": "filters:segmenter",
    "defense_masking.png": "filters:masking",
    "defense_temporal.png": "frames:temporal",
    "victim_dqn.svg": "decisions:dqn",
    "victim_ddpg.svg": "decisions:ddpg",
    "victim_clairvoyant.svg": "references:clairvoyant",
    "victim_ppo.png": "decisions:ppo",
    "victim_sac.png": "decisions:sac",
    "victim_planner.svg": "intervals:planner",
    "victim_blind.svg": "references:blind",
    "victim_random.svg": "references:random",
    "victim_idm.svg": "references:idm",
    "victim_sb3.svg": "policy_files:sb3_file",
    "victim_torch.png": "policy_files:torch_file",
    "victim_onnx.svg": "policy_files:onnx_file",
    "victim_yolov3_tiny.png": "detectors:yolov3_tiny",
    "victim_yolov5.png": "detectors:yolov5",
    "victim_fcos.png": "detectors:fcos",
    "victim_rcnn.png": "detectors:rcnn",
    "victim_detector.svg": "detector_files:detector_file",
    "world_highway.svg": "highway:world",
    "world_merge.svg": "roads:merge",
    "world_roundabout.svg": "roads:roundabout",
    "world_intersection.svg": "roads:intersection",
    "world_exit.svg": "roads:leave",
    "world_two_way.svg": "roads:two_way",
    "world_racetrack.svg": "roads:racetrack",
    "world_u_turn.svg": "roads:u_turn",
    "world_sumo.svg": "sumo:sumo",
    "world_sumo_crossing.svg": "sumo:crossing",
    "world_platoon.png": "platoon:world",
    "world_camera.webp": "camera:world",
    "world_crossing.png": "crossing:world",
    "world_places.png": "camera:places",
    "world_windscreen.png": "camera:windscreen",
    "decoys.png": "camera:decoys",
    "leaderboard.svg": "leaderboard:standard",
}
"""The module and the function that makes each file."""
FOLDER = Path(__file__).parents[1] / "images"


def make(file: str, folder: Path) -> Path:
    """Make one figure and return its file."""
    from docs.figures.style import save

    module, function = FIGURES[file].split(":")
    path = folder / file
    save(getattr(import_module(f"docs.figures.{module}"), function)(), path)
    return path


def main() -> None:
    """Make the figures that the command line names."""
    names = {Path(file).stem: file for file in FIGURES}
    parser = argparse.ArgumentParser(
        prog="python -m docs.figures", description="Make the figures of the documentation."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"figures to make, by default all: {', '.join(names)}")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to")
    options = parser.parse_args()
    if unknown := set(options.names) - set(names):
        parser.error(f"unknown figure {', '.join(sorted(unknown))}; known: {', '.join(names)}")
    settle()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names or names:
        print(make(names[name], options.out))


if __name__ == "__main__":
    main()
