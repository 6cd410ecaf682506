"""TACO: joint LiDAR localization and 3D object detection with task-aware contrastive learning."""
