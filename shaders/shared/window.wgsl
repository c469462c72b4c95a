// Pixels from the middle of a window to its border.
const RADIUS: u32 = 5u;
// Windows of four neighbors together reach over 14 pixels, the taps; what each of them weighs in the windows around the
// pixels 0, 1, 2, 3. Gaussian weights with standard deviation 1.5 px and sum 1.
const STRIP: u32 = 4u;
const TAP_0 = vec4<f32>(0.0010283801, 0.0, 0.0, 0.0);
const TAP_1 = vec4<f32>(0.007598758, 0.0010283801, 0.0, 0.0);
const TAP_2 = vec4<f32>(0.036000773, 0.007598758, 0.0010283801, 0.0);
const TAP_3 = vec4<f32>(0.10936069, 0.036000773, 0.007598758, 0.0010283801);
const TAP_4 = vec4<f32>(0.21300554, 0.10936069, 0.036000773, 0.007598758);
const TAP_5 = vec4<f32>(0.26601172, 0.21300554, 0.10936069, 0.036000773);
const TAP_6 = vec4<f32>(0.21300554, 0.26601172, 0.21300554, 0.10936069);
const TAP_7 = vec4<f32>(0.10936069, 0.21300554, 0.26601172, 0.21300554);
const TAP_8 = vec4<f32>(0.036000773, 0.10936069, 0.21300554, 0.26601172);
const TAP_9 = vec4<f32>(0.007598758, 0.036000773, 0.10936069, 0.21300554);
const TAP_10 = vec4<f32>(0.0010283801, 0.007598758, 0.036000773, 0.10936069);
const TAP_11 = vec4<f32>(0.0, 0.0010283801, 0.007598758, 0.036000773);
const TAP_12 = vec4<f32>(0.0, 0.0, 0.0010283801, 0.007598758);
const TAP_13 = vec4<f32>(0.0, 0.0, 0.0, 0.0010283801);
