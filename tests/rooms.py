"""Which room of the code each test file is about: ``pytest -m edges`` runs that room's tests.

A new test file is named here; ``test_rooms`` holds the table to the folder.
"""

from __future__ import annotations

from pathlib import Path

ROOMS = {
    "sensor": "near and far images to depth: optics, calibration, focus, the cloud",
    "edges": "intensity to closed regions: operators, the stack, linking, walls, regions",
    "matching": "regions to part, pose and grasp; the database that is trained",
    "recordings": "reading, writing and importing recordings, whole and damaged",
    "pipeline": "stages, plugins, settings, and what runs again",
    "sweep": "grids of parameters, kept results, workers, the gallery",
    "why": "a pixel's story, and two results held against each other",
    "tune": "the live bench: its state, its server, its page, the native viewer",
    "teach": "the course: lessons, their claims, its page",
    "cli": "the commands and examples as a user runs them, and what they leave behind",
    "simulate": "recordings that are rendered",
    "figures": "the figures that the committed scene must keep",
}

FILES = {
    "test_acceptance": "figures",
    "test_answer_stages": "matching",
    "test_calibration_laws": "sensor",
    "test_calibration_report": "sensor",
    "test_cli": "cli",
    "test_compare": "why",
    "test_comparison": "why",
    "test_database": "matching",
    "test_depth_edges": "edges",
    "test_depth_score": "sensor",
    "test_difference_figures": "why",
    "test_difference_pictures": "why",
    "test_differences": "why",
    "test_digest": "pipeline",
    "test_edge_operators": "edges",
    "test_edge_scores": "edges",
    "test_edge_stack": "edges",
    "test_eigenspace": "matching",
    "test_errors": "cli",
    "test_examples": "cli",
    "test_export": "cli",
    "test_from_optics": "sensor",
    "test_import": "recordings",
    "test_link_geometry": "edges",
    "test_linked_edges": "edges",
    "test_matching": "matching",
    "test_matching_scores": "matching",
    "test_occlusion": "matching",
    "test_odd_images": "pipeline",
    "test_optics": "sensor",
    "test_packaging": "cli",
    "test_partial": "matching",
    "test_pipeline": "pipeline",
    "test_pipeline_keys": "pipeline",
    "test_planes": "edges",
    "test_plugins": "pipeline",
    "test_pose": "matching",
    "test_predicted_error": "sensor",
    "test_recognition": "matching",
    "test_recognition_scores": "matching",
    "test_recorded_truth": "figures",
    "test_recording": "recordings",
    "test_recording_damage": "recordings",
    "test_recording_untidy": "recordings",
    "test_recording_writer": "recordings",
    "test_region_shapes": "edges",
    "test_regions": "edges",
    "test_registration_laws": "sensor",
    "test_replay": "cli",
    "test_report": "pipeline",
    "test_rooms": "cli",
    "test_run_report": "pipeline",
    "test_search": "why",
    "test_segmentation": "edges",
    "test_sensor": "sensor",
    "test_sensor_limits": "sensor",
    "test_sensor_speedups": "sensor",
    "test_session": "pipeline",
    "test_settings": "pipeline",
    "test_simulate": "simulate",
    "test_sizes": "edges",
    "test_stage_figures": "pipeline",
    "test_stage_in_parts": "pipeline",
    "test_surfaces": "matching",
    "test_surroundings": "cli",
    "test_sweep": "sweep",
    "test_sweep_axes": "sweep",
    "test_sweep_gallery": "sweep",
    "test_sweep_kept": "sweep",
    "test_sweep_parts": "sweep",
    "test_sweep_worker": "sweep",
    "test_teach": "teach",
    "test_teach_page": "teach",
    "test_train": "matching",
    "test_training": "matching",
    "test_tune_canvas": "tune",
    "test_tune_live": "tune",
    "test_tune_native": "tune",
    "test_tune_page": "tune",
    "test_tune_server": "tune",
    "test_viewer": "cli",
    "test_wall_geometry": "edges",
    "test_walls": "edges",
    "test_why": "why",
}


def problem(folder: Path) -> str:
    """What is wrong with the table for the test files of a folder; empty where nothing is."""
    there = {path.stem for path in folder.glob("test_*.py")}
    if there - FILES.keys():
        return f"tests/rooms.py: in no room: {', '.join(sorted(there - FILES.keys()))}"
    if FILES.keys() - there:
        return f"tests/rooms.py: no such test file: {', '.join(sorted(FILES.keys() - there))}"
    if set(FILES.values()) != ROOMS.keys():
        return f"tests/rooms.py: rooms: {', '.join(sorted(set(FILES.values()) ^ ROOMS.keys()))}"
    return ""
