"""
A camera calibrated by OpenCV
=============================

K, rvec and tvec of `cv2.calibrateCamera` give pose and pixel pitch of the lens. The image of a small glowing
sphere then lies where OpenCV projects its centre.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitsuba_fspt as fspt

K = np.array([[400.0, 0, 32], [0, 400, 24], [0, 0, 1]])  # pixels; the principal point in the middle of 64 × 48
rvec, tvec = np.array([0.3, -0.2, 0.1]), np.array([5.0, -3.0, 170.0])  # rad, mm
point = np.array([-6.0, 8.0, 4.0])  # mm, in the frame of the calibration target

camera = fspt.camera_from_opencv(K, rvec, tvec, width=64, height=48)
sensor = camera.sensor_xml(focal_length=55, f_number=22, focus_distance=170)
scene = f"""
<scene version="3.0.0">
    <integrator type="fspt_integral"/>
    {sensor}
    <shape type="sphere">
        <float name="radius" value="1.5"/> <point name="center" x="{point[0]}" y="{point[1]}" z="{point[2]}"/>
        <emitter type="fspt_surface"> <float name="exitance" value="1e-4"/> </emitter>
    </shape>
</scene>"""
image = fspt.render(fspt.load(scene), rtol=1e-2)

# %%
# OpenCV's projection K (R x + t), with R from Rodrigues' formula; pixel centres have whole numbers there.
angle = np.linalg.norm(rvec)
x, y, z = rvec / angle
cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
u, v, w = K @ (rotation @ point + tvec)
rows, columns = np.indices(image.power.shape)
found = np.array([columns.ravel(), rows.ravel()]) @ image.power.ravel() / image.power.sum()

figure, axes = plt.subplots(figsize=(5, 3.6))
axes.imshow(image.power, cmap="inferno")
axes.plot(u / w, v / w, "c+", markersize=12, label="OpenCV")
axes.legend()
distance = float(np.hypot(*(found - [u / w, v / w])))
print(f"centroid {found.round(3)}, OpenCV {np.round([u / w, v / w], 3)}: {distance:.3f} pixels apart")
assert distance < 0.1
