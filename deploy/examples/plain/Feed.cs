// Prints where a robot is and how old that is, from the plain feed of SERN's relay.
//
//     mcs -r:NetMQ.dll Feed.cs && mono Feed.exe tcp://127.0.0.1:5570 /jackal1/odometry/filtered
//
// The topic is a nav_msgs/Odometry or a geometry_msgs/PoseStamped, of ROS 1 or ROS 2. docs/plain.md says more.
//
// NetMQ is the only dependency: the feed's header is 24 bytes of fixed layout, so nothing like MessagePack is needed to
// read it. This is C# 7, for Mono, Unity and .NET alike. In Unity run `Read` in a thread of its own and let Update take
// the last position from there: a scene that does not read while it is paused would find messages that waited.

using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.Text;
using NetMQ;
using NetMQ.Sockets;

/// <summary>The second of a message's three frames.</summary>
public struct FeedHeader
{
    public byte Version;
    /// <summary>0 control, 1 state, 2 bulk.</summary>
    public byte Urgency;
    /// <summary>The low 32 bits of the stream's count.</summary>
    public uint Seq;
    /// <summary>Unix time at the origin, by the origin's clock.</summary>
    public long StampNs;
    /// <summary>How old the message was when the relay sent it. No clock of ours is compared with another for it.</summary>
    public ulong AgeUs;
}

public static class Feed
{
    const int HeaderBytes = 24;

    /// <summary>FormatException for bytes that are no header of version 1.</summary>
    public static FeedHeader ReadHeader(byte[] bytes)
    {
        if (bytes.Length != HeaderBytes || bytes[0] != 1)
            throw new FormatException("no header of version 1 of the feed");
        return new FeedHeader
        {
            Version = bytes[0],
            Urgency = bytes[1],
            Seq = (uint)BigEndian(bytes, 4, 4),
            StampNs = (long)BigEndian(bytes, 8, 8),
            AgeUs = BigEndian(bytes, 16, 8),
        };
    }

    /// <summary>x, y, z of the pose. FormatException for bytes that are neither of the two types.
    /// A body begins with four bytes (the seq in ROS 1, the encapsulation in ROS 2), the stamp in eight, and frame_id
    /// behind its length in four. In ROS 2 a string ends in NUL, and a value stands at a multiple of its size, counted
    /// from byte 4.</summary>
    public static double[] PositionM(byte[] body)
    {
        int at = BehindString(body, 12);
        // A seq of ROS 1 may be the same two bytes as the encapsulation; its frame_id has no NUL.
        bool ros2 = body[0] == 0 && body[1] == 1 && at > 16 && body[at - 1] == 0;
        int size = 56; // of the pose in a PoseStamped: seven doubles
        if (body.Length >= at + size + 8) // longer than a PoseStamped with its padding: an Odometry
        {
            if (ros2)
                at += -at & 3;
            at = BehindString(body, at); // child_frame_id
            size = 680; // pose and twist, each with its covariance
        }
        if (ros2)
            at += (4 - at) & 7;
        if (body.Length != at + size)
            throw new FormatException("no Odometry and no PoseStamped");
        return new[] { Double(body, at), Double(body, at + 8), Double(body, at + 16) };
    }

    /// <summary>Prints what comes, for ever.</summary>
    public static void Read(string address, string topic)
    {
        var clock = Stopwatch.StartNew();
        double heardS = 0, bornS = 0;
        bool heard = false;
        List<byte[]> frames = null;
        using (var socket = new SubscriberSocket())
        {
            socket.Subscribe(Encoding.UTF8.GetBytes(topic + "\0")); // without the NUL, /odom would be /odom_filtered as well
            socket.Connect(address); // the relay may come later, or again
            while (true)
            {
                if (!socket.TryReceiveMultipartBytes(TimeSpan.FromSeconds(1), ref frames))
                {
                    double nowS = clock.Elapsed.TotalSeconds;
                    string last = heard ? Say(": the last is {0:F1} s old", nowS - bornS) : "";
                    Console.WriteLine(Say("nothing for {0:F0} s{1}", nowS - heardS, last));
                    continue;
                }
                // Of several that wait here, the newest: only that one is as old as it says.
                List<byte[]> newer = null;
                while (socket.TryReceiveMultipartBytes(TimeSpan.Zero, ref newer))
                {
                    frames = newer;
                    newer = null;
                }
                FeedHeader header = ReadHeader(frames[1]);
                double ageS = header.AgeUs * 1e-6;
                heardS = clock.Elapsed.TotalSeconds;
                bornS = heardS - ageS; // on our own clock
                heard = true;
                string what;
                try
                {
                    double[] at = PositionM(frames[2]);
                    what = Say("x {0:F3} y {1:F3} z {2:F3} m", at[0], at[1], at[2]);
                }
                catch (FormatException)
                {
                    what = Say("no Odometry and no PoseStamped, {0} bytes", frames[2].Length);
                }
                string name = Encoding.UTF8.GetString(frames[0], 0, frames[0].Length - 1);
                Console.WriteLine(Say("{0} {1}: {2}, {3:F3} s old", name, header.Seq, what, ageS));
            }
        }
    }

    public static int Main(string[] arguments)
    {
        if (arguments.Length != 2)
        {
            Console.Error.WriteLine("usage: Feed.exe ADDRESS TOPIC");
            return 1;
        }
        Read(arguments[0], arguments[1]);
        return 0;
    }

    /// <summary>With a point in numbers, whatever the language of the machine.</summary>
    static string Say(string format, params object[] values)
    {
        return string.Format(CultureInfo.InvariantCulture, format, values);
    }

    static ulong BigEndian(byte[] bytes, int at, int count)
    {
        ulong value = 0;
        for (int index = at; index < at + count; index++)
            value = value << 8 | bytes[index];
        return value;
    }

    /// <summary>Where a string ends whose length stands at `at`, in four bytes, little endian.</summary>
    static int BehindString(byte[] body, int at)
    {
        if (body.Length < at + 4)
            throw new FormatException("no Odometry and no PoseStamped");
        uint length = (uint)(body[at] | body[at + 1] << 8 | body[at + 2] << 16 | body[at + 3] << 24);
        if (length > body.Length - at - 4)
            throw new FormatException("no Odometry and no PoseStamped");
        return at + 4 + (int)length;
    }

    /// <summary>A double, little endian as in the body; so is every machine that Unity or Mono runs on today.</summary>
    static double Double(byte[] body, int at)
    {
        return BitConverter.ToDouble(body, at);
    }
}
