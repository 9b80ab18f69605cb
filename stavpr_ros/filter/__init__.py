# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The method: a Bayes filter over the places of a map, and the path of the latest images.

Given are z-normalized distances z[y] of each image to the places y of the map: mean 0 and
deviation 1 at wrong places, mean mu < 0 at the right one. A state is a level k (how near right
places are on this drive, mu_k), a speed v (places an image) and a place y; beside them there is a
state off the map. With each image:

1. Level and speed change rarely, and the place moves on by the r places of its speed, one more or
   less with the probability e (:mod:`.model`)::

       b[k, v, y] = sum_j P(k after j) a[j, v, y]
       m[k, v, y] = sum_w P(v after w) b[k, w, y]
       s[k, v, y] = (1 - 2 e) m[k, v, y-r] + e m[k, v, y-r-1] + e m[k, v, y-r+1]

   P(v after w) includes the likelihood of the speed v by the change of the images
   (:mod:`.motion`).
2. States leave the map or come to it, and are weighed by the image (:mod:`.place_filter`, compiled
   in :mod:`.kernels`)::

       a'[k, v, y] = ((1 - leave) s[k, v, y] + birth[k]) exp(alpha (mu_k z[y] - mu_k^2 / 2))

   The exponent alpha grows with the change from the image before: equal images add nothing.
3. The place of an image is read a few images later: probable states are followed back
   (:mod:`.paths`), and the probabilities of places within 2 of each other add up.
4. The path through the most probable place is refined by all images of the window
   (:mod:`.refine`) and checked as a whole (:mod:`.checks`); where the checks refute it, the next
   one is taken. :mod:`.choice` gives the probability of the path.

Sessions of a map are columns with gaps between them (:mod:`.columns`), the mean of z of each place
over the latest images corrects for places that are near to everything (:mod:`.place_means`).
:class:`Filter` is what a window needs of a filter. A camera that passes places 0 to 39 of a map of
100 at 1 place an image, in noise of deviation 1:

>>> import numpy as np
>>> from stavpr_ros.filter import PlaceFilter
>>> rng = np.random.default_rng(0)
>>> filter = PlaceFilter(places=100, lag=10)
>>> same_speed = np.ones(len(filter.settings.speeds))
>>> for image in range(40):
...     z = rng.standard_normal(100).astype(np.float32)
...     z[image] -= 3
...     filter.update(z, weight=0.28, speed_weights=same_speed)
>>> belief = filter.belief(n=100, images_ago=10)
>>> best = belief.weights.argmax()
>>> int(belief.places[best]), bool(belief.weights[best] > 0.9)
(29, True)
>>> filter.path(belief.states[best], images=10).tolist()
[39, 38, 37, 36, 35, 34, 33, 32, 31, 30, 29]
"""

from stavpr_ros.filter.model import FilterSettings
from stavpr_ros.filter.paths import Belief
from stavpr_ros.filter.place_filter import PlaceFilter
from stavpr_ros.filter.protocol import Filter

__all__ = ['Belief', 'Filter', 'FilterSettings', 'PlaceFilter']
