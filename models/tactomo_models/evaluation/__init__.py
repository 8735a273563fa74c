"""How right the reconstruction is: scenes with known truth, measures, and reports.

    for scene in scenes(load_description("paper_square"), "tuning", 10, snr_db=40):
        reconstructor = Reconstructor(scene.description)
        reconstructor.set_reference(scene.reference)
        frame = reconstructor.reconstruct(scene.magnitude, scene.structure)
        ... frame.map, scene.truth.map

Everything here is simulated, and says so where it is shown.
"""

from tactomo_models.evaluation.scenes import EvaluationScene, scenes

__all__ = ["EvaluationScene", "scenes"]
