#!/usr/bin/env bash
# One guesses: an ArUco marker that stands straight in an image, 60 pixels wide, is found straight and 59 or 60 pixels wide, sharp or blurred.
# What happens: with the default corners a slight blur turns it by 1.9 degrees (a marker of 120 pixels by 1.0), always to the same side. The four
# refinements give three widths, and those of AprilTag count from the corner of a pixel, all others from its centre.
# For whom it matters: a printed patch that is cut out or placed by its marker is turned and half a pixel off, and the attack on it looks weaker.
# Versions: opencv-python-headless 5.0.0.93 (modules/objdetect, aruco_detector.cpp, ArucoDetector.detectMarkers, CORNER_REFINE_*).
# Source: a drawn marker under Gaussian blurs, with its true corners beside those found.
source "$(dirname "$0")/fresh.sh"
fresh opencv-python-headless==5.0.0.93 numpy
see <<'P'
import cv2
import numpy as np

WORDS = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
WAYS = {way: getattr(cv2.aruco, f"CORNER_REFINE_{way.upper()}") for way in ("none", "subpix", "contour", "apriltag")}


def found(side, blur, way, number=7):
    """Turn in degrees, width, and left edge of a marker whose pixels are 50 to 50 + side - 1."""
    image = np.full((side + 100, side + 100), 255, np.uint8)
    image[50 : 50 + side, 50 : 50 + side] = cv2.aruco.generateImageMarker(WORDS, number, side)
    image = cv2.GaussianBlur(image, (0, 0), blur) if blur else image
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = WAYS[way]
    corners, _, _ = cv2.aruco.ArucoDetector(WORDS, parameters).detectMarkers(image)
    upper = corners[0][0][1] - corners[0][0][0]
    return tuple(round(float(one), 1) for one in (np.degrees(np.arctan2(upper[1], upper[0])), np.linalg.norm(upper), corners[0][0][:, 0].min()))


sharp = {way: found(60, 0, way) for way in WAYS}
turns = {f"{side} pixels, blur {blur}": {found(side, blur, "none", number)[0] for number in range(20)} for side in (60, 120) for blur in (1.0, 1.5, 2.0)}
others = {way: found(60, 1.5, way)[0] for way in WAYS if way != "none"}
print(f"OpenCV {cv2.__version__}: turn, width and left edge of a sharp marker of 60 pixels from 50 on: {sharp}; turns of 20 markers by default: {turns}; "
      f"with the refinements, blur 1.5: {others}")
raise SystemExit(
    {way: one[1:] for way, one in sharp.items()} != {"none": (59.0, 50.0), "subpix": (59.8, 49.6), "contour": (59.0, 50.0), "apriltag": (60.0, 50.0)}
    or turns["60 pixels, blur 1.0"] != {0.0}
    or any(turns[f"{side} pixels, blur {blur}"] != {turn} for side, turn in ((60, 1.9), (120, 1.0)) for blur in (1.5, 2.0))
    or any(abs(turn) > 0.1 for turn in others.values())
)
P
